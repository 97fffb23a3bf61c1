"""Visual hull, points and marching cubes on a ball whose silhouettes are known exactly."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.spatial
import trimesh

from bigs.fused.shape import border_distances
from bigs.geometry.surface import (
    DistanceGrid,
    VisualHull,
    blend_with_points,
    convex_distance,
    empty_grid,
    extract_mesh,
    inlier_points,
    plane_scatter,
    silhouette_around_points,
)

RADIUS, DISTANCE = 0.05, 0.5
MIDDLE = np.array([0.02, -0.01, 0.015])  # of the ball in the object's frame
K = np.array([[300.0, 0, 95.0], [0, 300.0, 85.0], [0, 0, 1]])
SIZE = (170, 190)
PIXEL = DISTANCE / K[0, 0]  # metres per pixel at the ball
NO_POINTS = np.empty((0, 3))


def even_directions(count: int) -> np.ndarray:
    """Points [count, 3] spread evenly on the unit sphere."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=-1)


def looking_along(direction: np.ndarray) -> np.ndarray:
    """A rotation whose third row is `direction`."""
    side = np.cross(direction, [0.3, 0.9, -0.2])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(direction, side), direction])


def ball_mask(middle_cam: np.ndarray) -> np.ndarray:
    """Pixels [H, W] whose centre's ray hits a ball at `middle_cam`."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones(SIZE)], axis=-1)
    along = rays @ middle_cam / np.linalg.norm(rays, axis=-1)
    return middle_cam @ middle_cam - along**2 < RADIUS**2


@pytest.fixture(scope="module")
def masks_and_hull() -> tuple[np.ndarray, VisualHull]:
    rotations = np.stack([looking_along(d) for d in even_directions(40)])
    centers = np.tile([0.01, -0.02, DISTANCE], (40, 1))
    masks = np.stack([ball_mask(r @ MIDDLE + c) for r, c in zip(rotations, centers, strict=True)])
    silhouettes = np.stack([border_distances(mask) for mask in masks])
    return masks, VisualHull(silhouettes, K, rotations, centers)


@pytest.fixture(scope="module")
def hull(masks_and_hull) -> VisualHull:
    return masks_and_hull[1]


def ball_grid(resolution: int = 40) -> DistanceGrid:
    grid = empty_grid(MIDDLE - 0.07, MIDDLE + np.array([0.07, 0.08, 0.09]), resolution)
    values = np.linalg.norm(grid.points() - MIDDLE, axis=-1) - RADIUS
    return DistanceGrid(values.reshape(grid.values.shape), grid.origin, grid.spacing)


def test_grid_covers_its_box_with_cubes() -> None:
    lower, upper = np.array([0.0, 1.0, 2.0]), np.array([0.4, 1.2, 2.3])
    grid = empty_grid(lower, upper, 8)
    assert grid.spacing == pytest.approx(0.05)
    points = grid.points().reshape(*grid.values.shape, 3)
    np.testing.assert_array_equal(points[0, 0, 0], lower)
    assert (points[-1, -1, -1] >= upper - 1e-9).all()
    assert (points[-1, -1, -1] < upper + 1.01 * grid.spacing).all()
    np.testing.assert_allclose(points[3, 1, 2], lower + 0.05 * np.array([3, 1, 2]))


def test_hull_of_a_ball_has_its_radius(hull: VisualHull) -> None:
    directions = even_directions(300)
    on_surface = hull.distance(MIDDLE + RADIUS * directions)
    # A hull contains its object; from 40 views it is hardly larger.
    assert on_surface.max() < PIXEL
    grid = empty_grid(MIDDLE - 0.07, MIDDLE + 0.07, 40)
    verts, _ = extract_mesh(
        DistanceGrid(hull.distance(grid.points()).reshape(grid.values.shape), grid.origin, grid.spacing),
        NO_POINTS,
    )
    radii = np.linalg.norm(verts - MIDDLE, axis=1)
    assert radii.min() > RADIUS - PIXEL and radii.max() < 1.12 * RADIUS
    assert radii.mean() == pytest.approx(RADIUS, abs=0.6 * PIXEL)
    np.testing.assert_allclose(
        hull.distance(MIDDLE + 1.5 * RADIUS * directions), 0.5 * RADIUS, atol=2 * PIXEL
    )


def test_hull_distance_grows_outwards(hull: VisualHull) -> None:
    directions = even_directions(60)
    outward = hull.slope(MIDDLE + RADIUS * directions, 0.5 * PIXEL)
    cosine = (outward * directions).sum(-1) / np.linalg.norm(outward, axis=-1)
    assert cosine.min() > 0.5 and cosine.mean() > 0.9


def test_hull_stops_only_where_it_may(hull: VisualHull) -> None:
    points = MIDDLE + 0.1 * np.random.default_rng(0).uniform(-1, 1, (400, 3))
    full, stopped = hull.distance(points), hull.distance(points, stop=0.01)
    near = full <= 0.01
    assert near.any() and not near.all()
    np.testing.assert_array_equal(stopped[near], full[near])
    assert (stopped[~near] > 0.01).all()


def test_points_that_no_frame_sees_count_as_inside() -> None:
    silhouette = border_distances(ball_mask(np.array([0.0, 0.0, DISTANCE])))
    one = VisualHull(silhouette[None], K, np.eye(3)[None], np.array([[0.0, 0.0, DISTANCE]]))
    behind, aside, outside = one.distance(np.array([[0.0, 0, -1.0], [0.9, 0, 0], [0.09, 0, 0]]))
    assert behind == aside == -1.0
    assert outside == pytest.approx(0.04, abs=PIXEL)


def test_one_wrong_frame_carves_nothing_when_two_must_agree(hull: VisualHull) -> None:
    wrong = hull.silhouettes.copy()
    wrong[7] = border_distances(np.tile(np.arange(SIZE[1]) < 3, (SIZE[0], 1)))
    points = MIDDLE + 0.8 * RADIUS * even_directions(50)
    alone = replace(hull, silhouettes=wrong).distance(points)
    agreed = replace(hull, silhouettes=wrong, agreeing=2).distance(points)
    assert (alone > 0).all() and (agreed < 0).all()


def test_with_agreement_the_second_or_third_largest_distance_counts(hull: VisualHull) -> None:
    points = MIDDLE + 0.07 * np.random.default_rng(1).uniform(-1, 1, (200, 3))
    single = [
        VisualHull(s[None], K, r[None], c[None]).distance(points)
        for s, r, c in zip(hull.silhouettes, hull.rotations, hull.centers, strict=True)
    ]
    ranked = np.sort(single, axis=0)
    for agreeing in (1, 2, 3):
        found = replace(hull, agreeing=agreeing).distance(points)
        np.testing.assert_allclose(found, ranked[-agreeing])
    two = replace(
        hull,
        silhouettes=hull.silhouettes[:2],
        rotations=hull.rotations[:2],
        centers=hull.centers[:2],
        agreeing=3,
    )
    assert (two.distance(points) == -1.0).all()


def half_allowed() -> np.ndarray:
    allowed = np.zeros(SIZE, dtype=bool)
    allowed[:, :90] = True
    return allowed


def at_pixels(columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Camera points [N, 3] at the object's distance on pixels' centres."""
    x = (columns + 0.5 - K[0, 2]) / K[0, 0]
    y = (rows + 0.5 - K[1, 2]) / K[1, 1]
    return DISTANCE * np.stack([x, y, np.ones_like(x)], axis=-1)


def test_a_patch_of_points_opens_the_silhouette_around_it() -> None:
    allowed = half_allowed()
    columns, rows = (a.ravel().astype(float) for a in np.meshgrid([130, 131, 132], [60, 61, 62]))
    opened = silhouette_around_points(allowed, at_pixels(columns, rows), K)
    assert (opened[60:63, 130:133] < 0).all()
    assert opened[61, 150] > 0 and opened[140, 131] > 0  # elsewhere the mask still speaks
    np.testing.assert_array_equal(opened[:, :80] < 0, True)


def test_strays_small_errors_and_unseen_points_open_nothing() -> None:
    allowed = half_allowed()
    plain = border_distances(allowed)
    strays = at_pixels(np.array([130.0, 20, 160]), np.array([30.0, 80, 140]))
    # 6 mm are 3.6 pixels here: a patch two pixels outside is within the poses' error.
    near = at_pixels(np.repeat([90.0, 91.0], 10), np.tile(np.arange(10.0), 2))
    aside = at_pixels(np.full(9, 900.0), np.arange(9.0))
    behind = -at_pixels(np.full(9, 130.0), np.arange(9.0))
    for points in (strays, near, aside, behind, np.concatenate([strays, near, behind])):
        np.testing.assert_array_equal(silhouette_around_points(allowed, points, K), plain)


def test_points_carve_a_hollow_that_silhouettes_cannot_show() -> None:
    grid = ball_grid()
    # A flat bottom 3 cm below the ball's pole, seen as points.
    side = np.linspace(-0.015, 0.015, 13)
    x, y = np.meshgrid(side, side)
    bottom = MIDDLE + np.stack([x.ravel(), y.ravel(), np.full(x.size, RADIUS - 0.03)], axis=-1)
    normals = np.tile([0.0, 0.0, 1.0], (len(bottom), 1))
    blended = blend_with_points(grid, bottom, normals, reach=0.05)

    def nearest_corner(z: float) -> int:
        return np.linalg.norm(grid.points() - MIDDLE - np.array([0.0, 0.0, z]), axis=-1).argmin()

    def at(z: float) -> float:
        return blended.values.ravel()[nearest_corner(z)]

    assert grid.values.ravel()[nearest_corner(0.03)] < 0
    assert at(0.03) > 0  # above the bottom, inside the ball: now empty
    assert at(0.01) < 0  # below it: still solid
    assert (blended.values >= grid.values).all()
    far = scipy.spatial.cKDTree(bottom).query(grid.points())[0] > 0.0501
    np.testing.assert_array_equal(blended.values.ravel()[far], grid.values.ravel()[far])
    np.testing.assert_array_equal(ball_grid().values, grid.values)  # the old grid is left alone


def test_scattered_points_do_not_shrink_what_a_tight_hull_bounds() -> None:
    grid, spread = ball_grid(), 0.0008
    directions = even_directions(6000)
    off = spread * np.random.default_rng(0).standard_normal(len(directions))
    points = MIDDLE + (RADIUS + off)[:, None] * directions
    blended = blend_with_points(grid, points, directions, reach=0.016)

    def mean_radius(surface: DistanceGrid) -> float:
        return np.linalg.norm(extract_mesh(surface, NO_POINTS)[0] - MIDDLE, axis=1).mean()

    assert mean_radius(blended) == pytest.approx(RADIUS, abs=5e-5)
    # What planes say that may only go inwards.
    inner = replace(blended, values=np.maximum(blended.values, grid.values))
    assert mean_radius(inner) < RADIUS - 1e-4
    scatter = plane_scatter(points, directions)
    assert scatter == pytest.approx(spread, rel=0.1)
    assert (grid.values - blended.values).max() <= scatter
    # A point that is far off is not followed.
    points[0] += 0.01 * directions[0]
    stray = blend_with_points(grid, points, directions, reach=0.016)
    assert (grid.values - stray.values).max() <= plane_scatter(points, directions) < 1.1 * scatter


def test_points_on_their_planes_do_not_scatter() -> None:
    flat = np.concatenate([np.random.default_rng(1).random((40, 2)), np.zeros((40, 1))], axis=1)
    upwards = np.tile([0.0, 0.0, 1.0], (40, 1))
    assert plane_scatter(flat, upwards) == 0.0
    assert plane_scatter(flat[:1], upwards[:1]) == 0.0  # nothing to compare it with


def test_mesh_of_a_ball_is_closed_and_looks_outwards() -> None:
    verts, faces = extract_mesh(ball_grid(), NO_POINTS)
    mesh = trimesh.Trimesh(verts, faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)
    np.testing.assert_allclose(np.linalg.norm(verts - MIDDLE, axis=1), RADIUS, atol=1e-4)


def test_mesh_is_closed_where_the_solid_meets_the_grids_border() -> None:
    grid = empty_grid(np.zeros(3), np.ones(3), 8)
    full = DistanceGrid(np.full(grid.values.shape, -0.1), grid.origin, grid.spacing)
    mesh = trimesh.Trimesh(*extract_mesh(full, NO_POINTS), process=False)
    assert mesh.is_watertight and 1.0 < mesh.volume < (1 + 2 / 8) ** 3


def two_balls() -> DistanceGrid:
    """A large one and a small one, apart."""
    grid = empty_grid(np.zeros(3), np.array([1.0, 0.5, 0.5]), 40)
    points = grid.points()
    large = np.linalg.norm(points - [0.25, 0.25, 0.25], axis=-1) - 0.2
    small = np.linalg.norm(points - [0.8, 0.25, 0.25], axis=-1) - 0.1
    return DistanceGrid(np.minimum(large, small).reshape(grid.values.shape), grid.origin, grid.spacing)


def test_mesh_is_the_largest_piece_alone() -> None:
    verts, faces = extract_mesh(two_balls(), NO_POINTS)
    np.testing.assert_allclose(np.linalg.norm(verts - 0.25, axis=1), 0.2, atol=2e-3)
    assert set(np.unique(faces)) == set(range(len(verts)))


def test_pieces_on_which_points_lie_are_kept() -> None:
    """A handle may come off where a surface is smoothed; a few strays make no piece of the object."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(108, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    large = 0.25 + 0.2 * directions[:100]
    small = [0.8, 0.25, 0.25] + 0.1 * directions[100:]
    alone = extract_mesh(two_balls(), NO_POINTS)
    few = extract_mesh(two_balls(), np.concatenate([large, small[:7]]))
    assert all((a == b).all() for a, b in zip(alone, few, strict=True))
    mesh = trimesh.Trimesh(*extract_mesh(two_balls(), np.concatenate([large, small])), process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * (0.2**3 + 0.1**3), rel=0.02)


def test_an_empty_grid_has_no_mesh() -> None:
    grid = empty_grid(np.zeros(3), np.ones(3), 4)
    with pytest.raises(ValueError, match="level"):
        extract_mesh(DistanceGrid(np.ones(grid.values.shape), grid.origin, grid.spacing), NO_POINTS)


def test_convex_distance_of_a_cube() -> None:
    cube = np.array(np.meshgrid([0.0, 1], [0.0, 1], [0.0, 1])).reshape(3, -1).T
    points = np.array([[0.5, 0.5, 0.5], [0.9, 0.5, 0.5], [1.0, 0.2, 0.3], [0.5, 0.5, 3.0]])
    np.testing.assert_allclose(convex_distance(points, cube), [-0.5, -0.1, 0.0, 2.0], atol=1e-12)


def test_stray_points_are_not_inliers() -> None:
    cloud = np.concatenate([RADIUS * even_directions(300), [[0.2, 0.0, 0.0], [0.0, -0.3, 0.1]]])
    keep = inlier_points(cloud)
    assert keep[:300].all() and not keep[300:].any()
    assert inlier_points(cloud[-5:]).all()

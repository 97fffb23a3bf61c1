"""Symmetries of surfaces of which one side was seen, with the truth known."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from bigs.geometry import symmetry_search
from bigs.geometry.mesh import sample_surface
from bigs.geometry.surface import distance_to_planes, empty_grid
from bigs.geometry.symmetry import EmptySpace, SeenSurface, Symmetry, completed
from bigs.geometry.symmetry_search import SymmetryConfig, find_symmetries

# Where the camera stands, as seen from the object: three faces of a box show.
VIEW = np.array([0.5, 0.6, 0.4]) / np.linalg.norm([0.5, 0.6, 0.4])


def seen_of(mesh: trimesh.Trimesh, color_axis: int = 2) -> tuple[SeenSurface, np.ndarray]:
    """Samples that face the camera, coloured by height, with half a millimetre of noise; and all samples."""
    points, normals = sample_surface(mesh.vertices, mesh.faces, 3000)
    noisy = points + np.random.default_rng(0).normal(size=points.shape) * 5e-4
    colors = np.abs(np.sin(40.0 * points[:, [color_axis]])) * [1.0, 0.5, 0.2]
    shown = normals @ VIEW > 0.25
    return SeenSurface(noisy[shown], normals[shown], colors[shown]), points


def outside(mesh: trimesh.Trimesh) -> EmptySpace:
    """What silhouettes all around would say: whatever is outside the convex hull is empty."""
    hull = trimesh.convex.convex_hull(mesh)
    origins, normals = hull.triangles_center, hull.face_normals
    planes = np.concatenate([normals, -(origins * normals).sum(-1, keepdims=True)], axis=1)
    grid = empty_grid(hull.bounds[0] - 0.02, hull.bounds[1] + 0.02, 100)
    empty = distance_to_planes(grid.points(), planes) > 0.004
    return EmptySpace(empty.reshape(grid.values.shape).astype(float), grid.origin, grid.spacing)


def missing(points: np.ndarray, truth: np.ndarray) -> float:
    """Share of the true samples without a point within 5 mm."""
    return float((cKDTree(points).query(truth)[0] > 0.005).mean())


@pytest.fixture(scope="module")
def bottle() -> trimesh.Trimesh:
    """A body of revolution about a tilted axis."""
    outline = [[0, 0], [0.035, 0], [0.035, 0.1], [0.012, 0.13], [0.012, 0.16], [0, 0.16]]
    mesh = trimesh.creation.revolve(outline, sections=64)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.3, [1, 0.2, 0]))
    return mesh


def test_planes_of_a_wedge_that_has_one() -> None:
    """A wedge is mirrored by one plane only; that one is found, to 3 mm and two degrees."""
    outline = np.array([[0.0, 0.0], [0.15, 0.0], [0.03, 0.09]])
    wedge = trimesh.creation.extrude_triangulation(outline, np.array([[0, 1, 2]]), 0.08)
    surface, truth = seen_of(wedge, color_axis=0)
    found = find_symmetries(surface, outside(wedge))
    assert {symmetry.kind for symmetry in found} == {"plane"}
    assert abs(found[0].direction[2]) > np.cos(np.radians(2.0))
    assert abs((found[0].point - [0, 0, 0.04]) @ found[0].direction) < 3e-3
    before, after = (
        missing(points, truth)
        for points in (surface.points, completed(surface, found, outside(wedge), 0.003).points)
    )
    assert after < before - 0.1


def test_earlier_symmetries_come_first_and_are_judged_like_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that is a little off leads to the right place where no vote does; a wrong one leads nowhere."""
    outline = np.array([[0.0, 0.0], [0.15, 0.0], [0.03, 0.09]])
    wedge = trimesh.creation.extrude_triangulation(outline, np.array([[0, 1, 2]]), 0.08)
    surface, _ = seen_of(wedge, color_axis=0)
    nowhere = Symmetry("plane", np.array([0.14, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    searched = []

    def candidates(surface: SeenSurface) -> list[Symmetry]:
        searched.append(len(surface.points))
        return [nowhere]

    monkeypatch.setattr(symmetry_search, "_plane_candidates", candidates)
    monkeypatch.setattr(symmetry_search, "_axis_candidates", lambda surface: [])
    assert find_symmetries(surface, outside(wedge)) == [] and searched == [len(surface.points)]
    searched.clear()
    turned = np.array([np.sin(np.radians(3.0)), 0.0, np.cos(np.radians(3.0))])
    near = Symmetry("plane", np.array([0.06, 0.03, 0.043]), turned)
    found = find_symmetries(surface, outside(wedge), earlier=[nowhere, near])[0]
    assert abs(found.direction[2]) > np.cos(np.radians(1.0))
    assert abs((found.point - [0, 0, 0.04]) @ found.direction) < 2e-3
    assert len(surface.points) not in searched
    assert find_symmetries(surface, outside(wedge), earlier=[nowhere]) == []


def test_a_body_of_revolution_is_completed(bottle: trimesh.Trimesh) -> None:
    surface, truth = seen_of(bottle)
    found = find_symmetries(surface, outside(bottle))
    assert found
    whole = completed(surface, found, outside(bottle), 0.003)
    assert missing(surface.points, truth) > 0.4
    assert missing(whole.points, truth) < 0.1
    # What was added lies on the true surface, too.
    added = whole.points[len(surface.points) :]
    assert np.median(cKDTree(truth).query(added)[0]) < 0.003


def test_an_axis_carries_by_turns() -> None:
    axis = Symmetry("axis", np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    one = SeenSurface(np.array([[0.2, 0.0, 0.3]]), np.array([[1.0, 0.0, 0.0]]), np.zeros((1, 3)))
    images = axis.images(one)
    assert len(images) == 11
    for image in images:
        np.testing.assert_allclose(np.hypot(image.points[0, 0] - 0.1, image.points[0, 1]), 0.1)
        np.testing.assert_allclose(image.points[0, 2], 0.3)
        np.testing.assert_allclose((image.points[0] - [0.1, 0, 0.3]) / 0.1, image.normals[0], atol=1e-12)


def test_a_plane_twice_is_nothing() -> None:
    rng = np.random.default_rng(1)
    direction = rng.normal(size=3)
    plane = Symmetry("plane", rng.normal(size=3), direction / np.linalg.norm(direction))
    surface = SeenSurface(rng.normal(size=(20, 3)), rng.normal(size=(20, 3)), rng.random((20, 3)))
    (there,) = plane.images(surface)
    (back,) = plane.images(there)
    np.testing.assert_allclose(back.points, surface.points, atol=1e-12)
    np.testing.assert_allclose(back.normals, surface.normals, atol=1e-12)


def test_a_lump_has_no_symmetry() -> None:
    """The convex hull of a few random points; nothing is completed on weak evidence."""
    lump = trimesh.convex.convex_hull(0.08 * np.random.default_rng(3).normal(size=(9, 3)))
    surface, _ = seen_of(lump)
    assert find_symmetries(surface, outside(lump)) == []


def test_colours_decide_only_where_the_shape_leaves_doubt() -> None:
    """Print need not continue from one side of a box to the other."""
    box = trimesh.creation.box((0.12, 0.06, 0.09))
    surface, _ = seen_of(box)
    rng = np.random.default_rng(0)
    printed = surface._replace(colors=rng.random(surface.colors.shape))
    found = find_symmetries(printed, outside(box))
    assert found
    for plane in found:
        assert np.abs(plane.direction).max() > np.cos(np.radians(3.0))
    assert find_symmetries(printed, outside(box), SymmetryConfig(plain_support=1.0)) == []
    plain = surface._replace(colors=np.full_like(surface.colors, 0.5))
    assert find_symmetries(plain, outside(box), SymmetryConfig(plain_support=1.0))


def test_mirror_planes_stand_at_whole_parts_of_a_turn() -> None:
    """A square prism has planes at 45 degrees; none are taken at angles whose rotations never close."""
    prism = trimesh.creation.box((0.08, 0.08, 0.12))
    surface, _ = seen_of(prism)
    found = find_symmetries(surface, outside(prism))
    assert len(found) >= 2
    for first, second in itertools.combinations(found, 2):
        angle = np.degrees(np.arccos(min(abs(first.direction @ second.direction), 1.0)))
        assert np.abs(angle - np.array([45.0, 60.0, 90.0])).min() < 5.0


class Box(NamedTuple):
    """A box of one colour, and its symmetries."""

    surface: SeenSurface
    empty: EmptySpace
    found: list[Symmetry]


@pytest.fixture(scope="module")
def plain_box() -> Box:
    box = trimesh.creation.box((0.12, 0.06, 0.09))
    surface, _ = seen_of(box)
    plain, empty = surface._replace(colors=np.full_like(surface.colors, 0.5)), outside(box)
    return Box(plain, empty, find_symmetries(plain, empty))


def test_planes_at_other_angles_are_left(plain_box: Box, monkeypatch: pytest.MonkeyPatch) -> None:
    """If no two planes could stand at right angles, a box would keep its first alone."""
    assert len(plain_box.found) > 1
    monkeypatch.setattr(symmetry_search, "_BETWEEN_PLANES", np.array([20.0]))
    assert len(find_symmetries(plain_box.surface, plain_box.empty)) == 1


def test_later_planes_need_more_evidence(plain_box: Box) -> None:
    """Samples that the first plane has added support a second one whether it is right or wrong."""
    assert len(plain_box.found) > 1
    stricter = SymmetryConfig(least_share_later=1.01)
    assert len(find_symmetries(plain_box.surface, plain_box.empty, stricter)) == 1


def test_planes_that_make_others_of_each_other_count_only_with_them() -> None:
    """A plane through an edge of a box mirrors its corner, but not what another plane makes of it."""
    box = trimesh.creation.box((0.12, 0.1, 0.04))
    points, normals = sample_surface(box.vertices, box.faces, 3000)
    surface = SeenSurface(points, normals, np.full_like(points, 0.5))
    judge = symmetry_search._Judge(surface, outside(box), SymmetryConfig())
    middle, edge = np.zeros(3), np.array([0.06, 0.05, 0.0])
    known = Symmetry("plane", middle, np.array([1.0, 0.0, 0.0]))
    assert judge._makes_others(Symmetry("plane", middle, np.array([0.0, 1.0, 0.0])), known)
    assert not judge._makes_others(Symmetry("plane", edge, np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)), known)
    twice = known.mirrored(Symmetry("plane", edge, np.array([0.6, 0.8, 0.0])))
    again = twice.mirrored(Symmetry("plane", edge, np.array([0.6, 0.8, 0.0])))
    np.testing.assert_allclose(again.point, known.point, atol=1e-12)
    np.testing.assert_allclose(again.direction, known.direction, atol=1e-12)
    assert not np.allclose(twice.direction, known.direction)


def test_too_little_was_seen() -> None:
    few = SeenSurface(np.random.default_rng(0).normal(size=(50, 3)), np.eye(3)[[0] * 50], np.zeros((50, 3)))
    nowhere = EmptySpace(np.zeros((2, 2, 2)), np.full(3, -10.0), 20.0)
    assert find_symmetries(few, nowhere) == []

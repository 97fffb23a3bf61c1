"""Where nothing speaks for the object's surface: the mesh ends, and hands meet nothing."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.spatial

from bigs.geometry.mesh import sample_surface
from bigs.geometry.support import Support, SurfaceSamples
from bigs.geometry.surface import DistanceGrid, empty_grid, extract_mesh

RADIUS = 0.05
NOTHING = np.empty((0, 3))


@pytest.fixture(scope="module")
def ball() -> DistanceGrid:
    grid = empty_grid(np.full(3, -0.07), np.full(3, 0.07), 40)
    values = np.linalg.norm(grid.points(), axis=1) - RADIUS
    return DistanceGrid(values.reshape(grid.values.shape), grid.origin, grid.spacing)


@pytest.fixture(scope="module")
def samples(ball: DistanceGrid) -> SurfaceSamples:
    points, normals = sample_surface(*extract_mesh(ball, np.empty((0, 3))), 4000)
    return SurfaceSamples(points, normals, points[:, 0] > 0.0)


def test_a_surface_seen_all_around_is_left_as_it_is(ball: DistanceGrid, samples: SurfaceSamples) -> None:
    support = Support(samples._replace(seen=np.ones(len(samples.seen), dtype=bool)), NOTHING)
    verts, faces = extract_mesh(ball, np.empty((0, 3)))
    kept, kept_faces = support.known_part(verts, faces, 0.01)
    np.testing.assert_array_equal(kept, np.arange(len(verts)))
    np.testing.assert_array_equal(kept_faces, faces)
    np.testing.assert_array_equal(support.without_guesses(ball, 0.01).values, ball.values)


def test_the_mesh_ends_at_its_reach(ball: DistanceGrid, samples: SurfaceSamples) -> None:
    verts, faces = extract_mesh(ball, np.empty((0, 3)))
    index, kept_faces = Support(samples, NOTHING).known_part(verts, faces, 0.02)
    kept = verts[index]
    distance = scipy.spatial.cKDTree(samples.points[samples.seen]).query(verts)[0]
    # Vertices of a mesh that is cut have a face left unless all theirs reached beyond.
    assert 0.98 * (distance < 0.02).sum() < len(kept) <= (distance < 0.02).sum() < len(verts)
    assert (distance[index] < 0.02).all()
    np.testing.assert_array_equal(np.unique(kept_faces), np.arange(len(kept)))
    normals = np.cross(
        kept[kept_faces[:, 1]] - kept[kept_faces[:, 0]], kept[kept_faces[:, 2]] - kept[kept_faces[:, 0]]
    )
    assert ((normals * kept[kept_faces].mean(1)).sum(-1) > 0).all()


def test_hands_meet_nothing_where_nothing_was_seen(ball: DistanceGrid, samples: SurfaceSamples) -> None:
    corners = ball.points()
    solid = Support(samples, NOTHING).without_guesses(ball, 0.015).values.ravel()
    was = ball.values.ravel()
    assert (solid >= was).all()
    # The seen half, deep inside too, is as it was.
    np.testing.assert_array_equal(solid[corners[:, 0] > 0.0], was[corners[:, 0] > 0.0])
    pole = np.linalg.norm(corners - [-RADIUS, 0.0, 0.0], axis=1) < 0.01
    assert (solid[pole] > 0.0).all() and (was[pole] < 0.0).any()
    # No further away than what is solid.
    to_seen = scipy.spatial.cKDTree(samples.points[samples.seen]).query(corners)[0]
    assert (solid <= np.maximum(was, to_seen)).all()


def test_a_measured_point_speaks_for_the_surface_around_it(
    ball: DistanceGrid, samples: SurfaceSamples
) -> None:
    point = np.array([[-RADIUS, 0.0, 0.0]])
    pole = np.linalg.norm(ball.points() - point, axis=1) < 0.005
    solid = Support(samples, point).without_guesses(ball, 0.015).values.ravel()
    np.testing.assert_array_equal(solid[pole], ball.values.ravel()[pole])

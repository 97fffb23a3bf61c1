"""What was seen of a surface: a ball before a camera, hidden by itself, by a mask, by another ball."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from bigs.geometry.coverage import (
    ObjectViews,
    coverage_by_direction,
    sphere_directions,
    times_empty,
    times_seen,
)

RADIUS, DISTANCE = 0.05, 0.5
K = np.array([[600.0, 0, 90], [0, 600, 90], [0, 0, 1]])


@pytest.fixture(scope="module")
def ball() -> tuple[np.ndarray, np.ndarray]:
    """Points and unit normals of a ball's surface, dense."""
    normals = sphere_directions(20_000)
    return RADIUS * normals, normals


def views(rotations: np.ndarray) -> ObjectViews:
    """Frames that show the ball and nothing else."""
    row, column = np.mgrid[:180, :180] + 0.5
    rays = np.stack([(column - 90) / 600, (row - 90) / 600, np.ones_like(row)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    shown = rays[..., 2] > np.sqrt(1 - (RADIUS / DISTANCE) ** 2)
    count = len(rotations)
    return ObjectViews(np.repeat(shown[None], count, 0), K, rotations, np.tile([0, 0, DISTANCE], (count, 1)))


def test_a_camera_sees_the_near_side(ball: tuple[np.ndarray, np.ndarray]) -> None:
    points, normals = ball
    seen = times_seen(views(np.eye(3)[None]), points, normals, points, 0.006)
    # What faces the camera by the least cosine of 0.2; perspective moves the border a little.
    assert seen[normals[:, 2] < -0.45].all()
    assert not seen[normals[:, 2] > 0.0].any()


def test_frames_add_up(ball: tuple[np.ndarray, np.ndarray]) -> None:
    points, normals = ball
    turned = trimesh.transformations.rotation_matrix(np.pi, [0, 1, 0])[:3, :3]
    seen = times_seen(views(np.stack([np.eye(3), turned, turned])), points, normals, points, 0.006)
    assert (seen[normals[:, 2] < -0.5] == 1).all()
    assert (seen[normals[:, 2] > 0.5] == 2).all()


def test_what_a_hand_covers_is_not_seen(ball: tuple[np.ndarray, np.ndarray]) -> None:
    points, normals = ball
    frame = views(np.eye(3)[None])
    frame.shown[0, :, :90] = False
    seen = times_seen(frame, points, normals, points, 0.006)
    assert not seen[points[:, 0] < -0.002].any()
    assert seen[(normals[:, 2] < -0.5) & (points[:, 0] > 0.002)].all()


def test_what_another_part_hides_is_not_seen(ball: tuple[np.ndarray, np.ndarray]) -> None:
    """A second ball stands between; by the masks alone the first would count as seen."""
    points, normals = ball
    before = points + np.array([0.0, 0.0, -0.15])
    seen = times_seen(views(np.eye(3)[None]), points, normals, np.concatenate([points, before]), 0.006)
    assert not seen[np.hypot(points[:, 0], points[:, 1]) < 0.04].any()


def test_nothing_is_before_what_shows(ball: tuple[np.ndarray, np.ndarray]) -> None:
    points, normals = ball
    near_side = points[normals[:, 2] < -0.5]
    frame = views(np.eye(3)[None])
    depths = np.array([[0.0, 0.0, -0.1], [0.0, 0.0, -0.053], [0.0, 0.0, 0.0], [0.3, 0.0, -0.1]])
    np.testing.assert_array_equal(times_empty(frame, depths, near_side, 0.006), [1, 0, 0, 0])


def test_coverage_by_direction() -> None:
    """Half a ball seen: all from that side, nothing from the other, half from between."""
    normals = sphere_directions(4000)
    directions = np.array([[0.0, 0, 1], [0, 0, -1], [1, 0, 0]])
    coverage = coverage_by_direction(normals, normals[:, 2] > 0, directions)
    np.testing.assert_allclose(coverage, [1.0, 0.0, 0.5], atol=0.01)


def test_directions_are_even() -> None:
    directions = sphere_directions(200)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0)
    cosines = directions @ directions.T - 2.0 * np.eye(200)
    angles = np.degrees(np.arccos(cosines.max(1)))
    assert angles.min() > 10.0 and angles.max() < 20.0

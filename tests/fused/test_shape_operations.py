"""What views say of a shape, against the same by formulas on whole arrays."""

from __future__ import annotations

import re

import numpy as np
import pytest
import shape_twin as twin
from scipy.spatial.transform import Rotation

from bigs.fused import shape
from bigs.fused.shape import Poses, SymmetryJudge
from bigs.geometry.symmetry import EmptySpace, SeenSurface, Symmetry

FRAMES, HEIGHT, WIDTH = 7, 90, 120
K = np.array([[150.0, 0, 61.3], [0, 148.0, 44.2], [0, 0, 1]])


@pytest.fixture(scope="module")
def poses() -> Poses:
    """Turned any way, half a metre before the camera, in one frame behind it."""
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(FRAMES, 3)) * 0.02 + [0, 0, 0.5]
    centers[3, 2] = -0.02
    return Poses(K, Rotation.random(FRAMES, rng=rng).as_matrix(), centers)


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(1).uniform(-0.25, 0.25, (5000, 3))


@pytest.fixture(scope="module")
def masks() -> np.ndarray:
    coarse = np.random.default_rng(2).random((FRAMES, HEIGHT // 10, WIDTH // 10)) < 0.6
    return coarse.repeat(10, axis=1).repeat(10, axis=2)


@pytest.fixture(scope="module")
def ball() -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of a ball."""
    normals = np.random.default_rng(3).normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return 0.08 * normals, normals


@pytest.mark.parametrize(("agreeing", "stop"), [(1, np.inf), (3, np.inf), (2, 0.01)])
def test_distances_to_cones(poses: Poses, points: np.ndarray, agreeing: int, stop: float) -> None:
    silhouettes = np.random.default_rng(4).normal(size=(FRAMES, HEIGHT, WIDTH)).astype(np.float32) * 10.0
    order = np.random.default_rng(5).permutation(FRAMES)
    arguments = (silhouettes, poses, points, order, agreeing, stop)
    found = shape.cone_distances(*arguments)
    np.testing.assert_allclose(found, twin.cone_distances(*arguments), atol=1e-9)
    assert len(np.unique(found)) > 1000


def test_what_shows(poses: Poses, masks: np.ndarray, ball: tuple[np.ndarray, np.ndarray]) -> None:
    arguments = (masks, poses, *ball, ball[0], 0.2, 0.006)
    found = shape.times_seen(*arguments)
    np.testing.assert_array_equal(found, twin.times_seen(*arguments))
    assert 0 < found.mean() < FRAMES


def test_what_would_hide(
    poses: Poses, points: np.ndarray, masks: np.ndarray, ball: tuple[np.ndarray, np.ndarray]
) -> None:
    arguments = (masks, poses, points, ball[0], 0.006)
    found = shape.times_empty(*arguments)
    np.testing.assert_array_equal(found, twin.times_empty(*arguments))
    assert found.max() > 1


def test_distances_beyond_planes(points: np.ndarray) -> None:
    planes = np.random.default_rng(6).normal(size=(50, 4))
    wanted = (points @ planes[:, :3].T + planes[:, 3]).max(1)
    np.testing.assert_allclose(shape.beyond_planes(points, planes), wanted, atol=1e-12)
    assert (shape.beyond_planes(points, planes[:0]) == -np.inf).all()


def bowl(rng: np.random.Generator) -> SeenSurface:
    """A part of a body of revolution about z with a little noise."""
    angle, height = rng.uniform(0, 4.0, 1500), rng.uniform(0, 0.1, 1500)
    radius = 0.05 + 0.3 * height
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    normals = np.stack([np.cos(angle), np.sin(angle), np.full(1500, -0.3)], axis=1)
    points += 3e-4 * rng.normal(size=points.shape)
    return SeenSurface(
        points, normals / np.linalg.norm(normals, axis=1, keepdims=True), rng.random((1500, 3))
    )


def judge(surface: SeenSurface, empty: EmptySpace, reach: float = 0.004) -> SymmetryJudge:
    return SymmetryJudge(surface, empty.values, empty.origin, empty.spacing, reach, 0.82, 12, 8)


@pytest.fixture(scope="module")
def space() -> EmptySpace:
    return EmptySpace(np.random.default_rng(7).random((12, 14, 9)), np.array([-0.1, -0.1, 0.0]), 0.015)


def rows(symmetries: list[Symmetry]) -> np.ndarray:
    return np.array([[*symmetry.point, *symmetry.direction] for symmetry in symmetries])


@pytest.mark.parametrize("kind", ["plane", "axis"])
def test_agreement(kind: str, space: EmptySpace) -> None:
    rng = np.random.default_rng(8)
    surface = bowl(rng)
    upright = np.array([0, 0, 1.0]) if kind == "axis" else np.array([0.8, 0.6, 0])
    others = [
        Symmetry(kind, 0.01 * rng.normal(size=3), d / np.linalg.norm(d)) for d in rng.normal(size=(5, 3))
    ]
    symmetries = [Symmetry(kind, np.zeros(3), upright), *others]
    found = judge(surface, space).agreement([kind == "axis"] * 6, rows(symmetries))
    for symmetry, values in zip(symmetries, found, strict=True):
        np.testing.assert_allclose(values, twin.agreement(surface, space, symmetry, 0.004, 0.82), atol=1e-9)
    assert found[0, 0] > max(0.3, *found[1:, 0])


@pytest.mark.parametrize("kind", ["plane", "axis"])
def test_a_symmetry_is_moved_to_where_it_is(kind: str, space: EmptySpace) -> None:
    """From some millimetres and degrees away to well below the noise of a sample."""
    surface = bowl(np.random.default_rng(9))
    upright = np.array([0, 0, 1.0]) if kind == "axis" else np.array([0.8, 0.6, 0])
    off = upright + 0.06 * np.random.default_rng(10).normal(size=3)
    start = Symmetry(kind, np.full(3, 0.002), off / np.linalg.norm(off))
    (row,) = judge(surface, space).refined([kind == "axis"], rows([start]), 0.2)
    found = Symmetry(kind, row[:3], row[3:])
    assert np.linalg.norm(found.direction) == pytest.approx(1.0)
    misfit = twin.off_planes(surface, 0.006)
    assert misfit(found) < 0.5 * misfit(start)
    if kind == "axis":
        assert abs(found.direction[2]) > np.cos(np.radians(0.5))
        assert np.linalg.norm(found.point[:2] - found.point[2] * found.direction[:2]) < 5e-4
    else:
        # Any plane through the axis will do.
        assert abs(found.direction[2]) < np.sin(np.radians(0.5))
        assert abs(found.point @ found.direction) < 5e-4


def test_what_meets_nothing_stays(space: EmptySpace) -> None:
    start = Symmetry("plane", np.array([0.5, 0, 0]), np.array([1.0, 0, 0]))
    made = judge(bowl(np.random.default_rng(11)), space)
    np.testing.assert_array_equal(made.refined([False], rows([start]), 0.2), rows([start]))
    ((support, _, error),) = made.agreement([False], rows([start]))
    assert support == 0.0 and np.isnan(error)


def test_arrays_that_do_not_fit(
    poses: Poses, points: np.ndarray, masks: np.ndarray, space: EmptySpace
) -> None:
    with pytest.raises(ValueError, match=re.escape("shown: expected 64800 values, found 75600")):
        shape.times_empty(masks, Poses(K, poses.rotations[1:], poses.centers[1:]), points, points, 0.006)
    with pytest.raises(ValueError, match="rotations: expected 7 values, found 6"):
        shape.times_empty(masks, Poses(K, poses.rotations[1:], poses.centers), points, points, 0.006)
    with pytest.raises(ValueError, match=re.escape("shown: expected the shape (T, H, W)")):
        shape.times_empty(masks[0], poses, points, points, 0.006)
    with pytest.raises(ValueError, match="points: expected rows of 3 values"):
        shape.times_empty(masks, poses, points[:, :2], points, 0.006)
    with pytest.raises(ValueError, match="normals: expected 5000 values, found 4999"):
        shape.times_seen(masks, poses, points, points[1:], points, 0.2, 0.006)
    with pytest.raises(ValueError, match="symmetries: expected 2 rows, found 1"):
        judge(bowl(np.random.default_rng(0)), space).agreement([False, True], np.zeros((1, 6)))

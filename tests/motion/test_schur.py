"""The reduced normal equations against dense ones made of finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from turning_object import K

import bigs.motion.schur as schur
from bigs import _raster
from bigs.motion.bundle import Bundle, alike

SIGMA = 0.5


def noisy_bundle(frames: int, points: int, share: float, twice: int = 0) -> Bundle:
    """Points in a cube that turns, each seen in a share of the frames, half a pixel off; some twice."""
    rng = np.random.default_rng(0)
    turns = np.linspace(0.0, 1.0, frames)[:, None] * np.array([0.1, 1.0, 0.3])
    rotations = Rotation.from_rotvec(turns).as_matrix()
    transl = np.array([0.0, 0.01, 0.7]) + 0.01 * rng.standard_normal((frames, 3))
    places = rng.uniform(-0.05, 0.05, (points, 3))
    seen = rng.random((frames, points)) < share
    seen[:2] = True
    frame, point = np.nonzero(seen)
    again = rng.permutation(len(frame))[:twice]
    frame, point = np.append(frame, frame[again]), np.append(point, point[again])
    roots = rng.normal(0.0, 0.4, (len(frame), 2, 2)) + np.eye(2)
    precision = (roots @ roots.transpose(0, 2, 1))[:, [0, 0, 1], [0, 1, 1]]
    bundle = Bundle(rotations, transl, places, frame, point, np.zeros((len(frame), 2)), precision)
    return bundle._replace(pixels=bundle.residuals(K) + 0.5 * rng.standard_normal((len(frame), 2)))


def repeated(bundle: Bundle, copies: int) -> Bundle:
    """All points, and what was seen of them, so many times."""
    count = len(bundle.points)
    point = (bundle.point + count * np.arange(copies)[:, None]).ravel()
    times = lambda values: np.concatenate([values] * copies)  # noqa: E731
    return bundle._replace(
        points=times(bundle.points),
        frame=times(bundle.frame),
        point=point,
        pixels=times(bundle.pixels),
        precision=times(bundle.precision),
    )


def moved(bundle: Bundle, change: np.ndarray, free: np.ndarray) -> Bundle:
    """The bundle after a change [6F + 3P] of its free poses and of its points."""
    rotations, transl = bundle.rotations.copy(), bundle.transl.copy()
    poses = change[: 6 * int(free.sum())].reshape(-1, 6)
    rotations[free] = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ rotations[free]
    transl[free] += poses[:, 3:]
    points = bundle.points + change[poses.size :].reshape(-1, 3)
    return bundle._replace(rotations=rotations, transl=transl, points=points)


def whitened(bundle: Bundle) -> np.ndarray:
    """Reprojection errors [M, 2] whose squares count alike."""
    precision = bundle.precision[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    return np.einsum("mji,mj->mi", np.linalg.cholesky(precision), bundle.residuals(K))


def full_equations(bundle: Bundle, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton's matrix and gradient over poses and points, by central differences."""
    residual = whitened(bundle)
    weight = 1.0 / (SIGMA**2 + (residual**2).sum(1))
    count = 6 * int(free.sum()) + bundle.points.size
    columns = []
    for i in range(count):
        step = np.zeros(count)
        step[i] = 1e-6
        ahead, behind = whitened(moved(bundle, step, free)), whitened(moved(bundle, -step, free))
        columns.append(((ahead - behind) / 2e-6 * np.sqrt(weight)[:, None]).ravel())
    jacobian = np.stack(columns, axis=1)
    return jacobian.T @ jacobian, jacobian.T @ (residual * np.sqrt(weight)[:, None]).ravel()


@pytest.mark.parametrize("share", [1.0, 0.5])
@pytest.mark.parametrize("still", [(), (0, 3)])
@pytest.mark.parametrize("copies", [1, 400])
@pytest.mark.parametrize("twice", [0, 7])
def test_points_are_eliminated_exactly(share: float, still: tuple[int, ...], copies: int, twice: int) -> None:
    """Also where a frame has seen a point twice, as tracks that were joined wrongly do.

    So many copies of a few points are more than the engine takes at once, and their equations so many times
    those of the few.
    """
    few = noisy_bundle(6, 14, share, twice)
    bundle = repeated(few, copies)
    free = np.ones(6, dtype=bool)
    free[list(still)] = False
    frames = int(free.sum())
    seen = schur.sort_observations(bundle.frame, bundle.point, bundle.pixels, bundle.precision, free)
    scene = schur.Scene(bundle.rotations, bundle.transl, bundle.points[seen.points], K, SIGMA)
    system = schur.linearise(seen, scene)
    damping = 1e-2
    reduced = schur.reduce(system, seen, damping)

    matrix, gradient = full_equations(few, free)
    matrix[np.diag_indices_from(matrix)] *= 1.0 + damping
    own = slice(0, 6 * frames)
    rest = slice(6 * frames, None)
    across = np.linalg.solve(matrix[rest, rest], matrix[rest, own]).T
    np.testing.assert_allclose(
        reduced.matrix / copies,
        matrix[own, own] - across @ matrix[rest, own],
        rtol=1e-5,
        atol=1e-5 * matrix.max(),
    )
    np.testing.assert_allclose(
        reduced.gradient / copies,
        gradient[own] - across @ gradient[rest],
        atol=1e-5 * np.abs(gradient).max(),
    )
    # Solved as a whole, poses and points go where they go here.
    change = np.linalg.solve(reduced.matrix, -reduced.gradient)
    steps = np.empty_like(bundle.points)
    steps[seen.points] = schur.point_steps(system, reduced, seen, change.reshape(-1, 6))
    whole = np.linalg.solve(matrix, -gradient)
    np.testing.assert_allclose(change, whole[own], atol=1e-4 * np.abs(whole).max())
    for there in steps.reshape(copies, -1):
        np.testing.assert_allclose(there, whole[rest], atol=1e-4 * np.abs(whole).max())


def test_the_cost_is_the_sum_of_cauchy_losses() -> None:
    bundle = noisy_bundle(6, 14, 0.5, 7)
    seen = schur.sort_observations(
        bundle.frame, bundle.point, bundle.pixels, bundle.precision, np.ones(6, dtype=bool)
    )
    scene = schur.Scene(bundle.rotations, bundle.transl, bundle.points[seen.points], K, SIGMA)
    assert schur.cost_of_pixels(seen, scene) == pytest.approx(
        np.log1p((whitened(bundle) ** 2).sum(1) / SIGMA**2).sum(), rel=1e-12
    )


def test_indices_that_there_are_not_are_refused() -> None:
    frame, point = np.tile(np.arange(6), 4), np.repeat(np.arange(4), 6)
    rest = (np.zeros((24, 2)), alike(24), np.ones(6, dtype=bool))
    for there in (6, -1):
        wrong = np.where(np.arange(24) == 5, there, frame)
        with pytest.raises(ValueError, match=f"frame: expected 0 to 5, found {there}"):
            _raster.BundleSightings(wrong, point, *rest)
    with pytest.raises(ValueError, match="point: expected ranks in order"):
        _raster.BundleSightings(frame, point + 1, *rest)
    with pytest.raises(TypeError, match="frame: expected an array of int64"):
        _raster.BundleSightings(frame.astype(np.int32), point, *rest)


@pytest.mark.parametrize("least", [0.5, -0.5], ids=["positive", "with a negative direction"])
def test_pose_steps_solve_the_reduced_equations(least: float) -> None:
    """Also where rounding has left a negative direction, which a Cholesky factor cannot have."""
    rng = np.random.default_rng(4)
    axes = np.linalg.qr(rng.standard_normal((12, 12)))[0]
    matrix = axes @ np.diag([least, *np.linspace(1.0, 4.0, 11)]) @ axes.T
    reduced = schur.Reduced(matrix, rng.standard_normal(12), np.zeros((0, 3, 3)))
    steps = schur.pose_steps(reduced)
    assert steps.shape == (2, 6)
    np.testing.assert_allclose(matrix @ steps.ravel(), -reduced.gradient, atol=1e-12)

"""The reduced normal equations against dense ones made of finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from turning_object import K

import bigs.motion.schur as schur
from bigs.motion.bundle import Bundle

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
@pytest.mark.parametrize("batch", [8_000, 16])
@pytest.mark.parametrize("twice", [0, 7])
def test_points_are_eliminated_exactly(
    share: float, still: tuple[int, ...], batch: int, twice: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where a frame has seen a point twice, as tracks that were joined wrongly do."""
    monkeypatch.setattr(schur, "_BATCH", batch)
    bundle = noisy_bundle(6, 14, share, twice)
    free = np.ones(6, dtype=bool)
    free[list(still)] = False
    frames = int(free.sum())
    seen = schur.sort_observations(bundle.frame, bundle.point, bundle.pixels, bundle.precision, free)
    assert (len(seen.batches) > 1) == (batch == 16)
    points = bundle.points[seen.points]
    system = schur.linearise(seen, bundle.rotations, bundle.transl, points, K, SIGMA, frames)
    damping = 1e-2
    reduced = schur.reduce(system, seen, damping)

    matrix, gradient = full_equations(bundle, free)
    matrix[np.diag_indices_from(matrix)] *= 1.0 + damping
    own = slice(0, 6 * frames)
    rest = slice(6 * frames, None)
    across = np.linalg.solve(matrix[rest, rest], matrix[rest, own]).T
    np.testing.assert_allclose(
        reduced.matrix, matrix[own, own] - across @ matrix[rest, own], rtol=1e-5, atol=1e-5 * matrix.max()
    )
    np.testing.assert_allclose(
        reduced.gradient, gradient[own] - across @ gradient[rest], atol=1e-5 * np.abs(gradient).max()
    )
    # Solved as a whole, poses and points go where they go here.
    change = np.linalg.solve(reduced.matrix, -reduced.gradient)
    steps = np.empty_like(bundle.points)
    steps[seen.points] = schur.point_steps(system, reduced, seen, change.reshape(-1, 6))
    whole = np.linalg.solve(matrix, -gradient)
    np.testing.assert_allclose(change, whole[own], atol=1e-4 * np.abs(whole).max())
    np.testing.assert_allclose(steps.ravel(), whole[rest], atol=1e-4 * np.abs(whole).max())


@pytest.mark.parametrize("least", [0.5, -0.5], ids=["positive", "with a negative direction"])
def test_pose_steps_solve_the_reduced_equations(least: float) -> None:
    """Also where rounding has left a negative direction, which a Cholesky factor cannot have."""
    rng = np.random.default_rng(4)
    axes = np.linalg.qr(rng.standard_normal((12, 12)))[0]
    matrix = axes @ np.diag([least, *np.linspace(1.0, 4.0, 11)]) @ axes.T
    reduced = schur.Reduced(matrix, rng.standard_normal(12), [])
    steps = schur.pose_steps(reduced)
    assert steps.shape == (2, 6)
    np.testing.assert_allclose(matrix @ steps.ravel(), -reduced.gradient, atol=1e-12)

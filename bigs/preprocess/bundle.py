"""Bundle adjustment of one moving object under a prior for smooth motion.

The camera is still and known; unknown are the object's pose in every frame and its points. What is minimised
is a sum of Cauchy losses of reprojection errors and of each frame's second differences of pose, so that a
frame with few observations goes where its neighbours' motion leads. Gauss-Newton with Levenberg's damping;
the points are eliminated by a Schur complement.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class BundleConfig:
    """Scales of the Cauchy losses, and when to stop."""

    pixel_sigma: float = 0.25  # of a reprojection error, pixels
    turn_sigma: float = 0.3  # of the change of angular velocity, degrees a frame and frame
    shift_sigma: float = 0.0015  # of the change of velocity, in depths a frame and frame
    iterations: int = 15
    # Stop when a step lowers the cost by less than this share of it.
    tolerance: float = 1e-4


class Bundle(NamedTuple):
    """Poses of consecutive frames, points, and what was seen where."""

    rotations: np.ndarray  # [T, 3, 3] object to camera
    transl: np.ndarray  # [T, 3]
    points: np.ndarray  # [N, 3]
    frame: np.ndarray  # [M] frame of each observation
    point: np.ndarray  # [M] point of each observation
    pixels: np.ndarray  # [M, 2]

    def residuals(self, K: np.ndarray) -> np.ndarray:
        """Reprojection errors [M, 2] in pixels; huge where a point is behind the camera."""
        return _project(_in_camera(self), K) - self.pixels

    def depths(self) -> np.ndarray:
        """Depth [M] of every observed point in its frame."""
        return _in_camera(self)[:, 2]


def adjust(bundle: Bundle, K: np.ndarray, config: BundleConfig, *, free: np.ndarray | None = None) -> Bundle:
    """Minimise reprojection errors under the motion prior.

    Args:
        bundle: start values. A frame without observations is placed by the prior alone.
        K: [3, 3] intrinsics.
        config: see there.
        free: [T] bool, frames whose pose may change; all by default.

    Returns:
        The adjusted bundle; its gauge (pose and size of the object frame) is free to drift a little.
    """
    free = np.ones(len(bundle.rotations), dtype=bool) if free is None else free
    damping = 1e-3
    cost = _cost(bundle, K, config)
    for _ in range(config.iterations):
        system = _linearise(bundle, K, config, free)
        for _ in range(6):
            candidate = _step(bundle, system, free, damping)
            new_cost = _cost(candidate, K, config)
            if new_cost < cost:
                break
            damping *= 8.0
        else:
            return bundle
        gain, cost, bundle, damping = cost - new_cost, new_cost, candidate, max(damping / 6.0, 1e-7)
        if gain < config.tolerance * cost:
            break
    return bundle


def turn_uncertainties(bundle: Bundle, K: np.ndarray, config: BundleConfig) -> np.ndarray:
    """Standard deviation of each frame's rotation against that of every other, [T, T] degrees.

    To first order, for independent reprojection errors of `config.pixel_sigma`. The gauge has no part in it.
    """
    free = np.ones(len(bundle.rotations), dtype=bool)
    system = _linearise(bundle, K, config, free)
    covariance = np.linalg.pinv(_reduced(system, 0.0)[0], rcond=1e-10, hermitian=True)
    blocks = covariance.reshape(len(free), 6, len(free), 6)[:, :3, :, :3]
    own = np.einsum("titi->t", blocks)
    # A turn of frame s by d is seen in frame t as the same turn of the object, carried along.
    carry = np.einsum("tij,skj->tsik", bundle.rotations, bundle.rotations)
    cross = np.einsum("tisj,tsij->ts", blocks, carry)
    return np.degrees(np.sqrt((own[:, None] + own - 2.0 * cross).clip(0.0)))


class _System(NamedTuple):
    """Normal equations: poses [6F], points [3N], and their coupling."""

    poses: np.ndarray  # [6F, 6F]
    points: np.ndarray  # [N, 3, 3]
    coupling: scipy.sparse.bsr_matrix  # [6F, 3N]
    pose_gradient: np.ndarray  # [6F]
    point_gradient: np.ndarray  # [N, 3]


def _in_camera(bundle: Bundle) -> np.ndarray:
    points = bundle.points[bundle.point]
    return np.einsum("mij,mj->mi", bundle.rotations[bundle.frame], points) + bundle.transl[bundle.frame]


def _project(cam: np.ndarray, K: np.ndarray) -> np.ndarray:
    depth = np.where(cam[:, 2] > 1e-6, cam[:, 2], 1e-6)
    return cam[:, :2] / depth[:, None] * (K[0, 0], K[1, 1]) + K[:2, 2]


def _cauchy(squared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Loss and weight of squared norms in units of their scale."""
    return np.log1p(squared), 1.0 / (1.0 + squared)


def _soft(squared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same for a loss that grows like the norm itself: a real change of motion costs, but is not free."""
    root = np.sqrt(1.0 + squared)
    return 2.0 * (root - 1.0), 1.0 / root


def _cost(bundle: Bundle, K: np.ndarray, config: BundleConfig) -> float:
    pixel, _ = _cauchy((bundle.residuals(K) ** 2).sum(1) / config.pixel_sigma**2)
    turn, shift = _accelerations(bundle, config)
    return float(pixel.sum() + _soft((turn**2).sum(1))[0].sum() + _soft((shift**2).sum(1))[0].sum())


def _accelerations(bundle: Bundle, config: BundleConfig) -> tuple[np.ndarray, np.ndarray]:
    """Second differences of rotation and position [T - 2, 3], in units of their scales."""
    steps = bundle.rotations[1:] @ bundle.rotations[:-1].transpose(0, 2, 1)
    velocity = Rotation.from_matrix(steps).as_rotvec()
    depth = float(np.median(bundle.transl[:, 2]))
    return (
        np.diff(velocity, axis=0) / np.radians(config.turn_sigma),
        np.diff(bundle.transl, 2, axis=0) / (config.shift_sigma * depth),
    )


def _linearise(bundle: Bundle, K: np.ndarray, config: BundleConfig, free: np.ndarray) -> _System:
    """Normal equations about `bundle`; a pose changes by a turn about the object's origin, and a shift."""
    residual, rows_pose, rows_point = _jacobians(bundle, K)
    weight = _cauchy((residual**2).sum(1) / config.pixel_sigma**2)[1] / config.pixel_sigma**2
    root = np.sqrt(weight)[:, None]
    residual, rows_pose, rows_point = root * residual, root[:, None] * rows_pose, root[:, None] * rows_point

    count, frames = len(bundle.points), int(free.sum())
    points = _sum_by(bundle.point, _products(rows_point, rows_point), count)
    point_gradient = _sum_by(bundle.point, _products(rows_point, residual[:, :, None])[:, :, 0], count)

    slot = np.cumsum(free) - 1
    moving = np.flatnonzero(free[bundle.frame])
    # In the order of the coupling's rows.
    moving = moving[np.lexsort((bundle.point[moving], slot[bundle.frame[moving]]))]
    row, rows_pose = slot[bundle.frame[moving]], rows_pose[moving]
    poses = np.zeros((frames, 6, frames, 6))
    diagonal = np.arange(frames)
    poses[diagonal, :, diagonal, :] = _sum_by(row, _products(rows_pose, rows_pose), frames)
    pose_gradient = _sum_by(row, _products(rows_pose, residual[moving][:, :, None])[:, :, 0], frames)
    starts = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=frames))])
    coupling = scipy.sparse.bsr_matrix(
        (_products(rows_pose, rows_point[moving]), bundle.point[moving], starts),
        shape=(6 * frames, 3 * count),
        blocksize=(6, 3),
    )
    _add_prior(poses, pose_gradient, bundle, config, free, slot)
    return _System(
        poses.reshape(6 * frames, 6 * frames), points, coupling, pose_gradient.ravel(), point_gradient
    )


def _jacobians(bundle: Bundle, K: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reprojection errors [M, 2], and how they change with the pose [M, 2, 6] and the point [M, 2, 3].

    Element by element: products of many small matrices take numpy most of an adjustment's time.
    """
    rotation = bundle.rotations[bundle.frame]
    cam = _in_camera(bundle)
    right, down, ahead = (cam - bundle.transl[bundle.frame]).T
    depth = np.where(cam[:, 2] > 1e-6, cam[:, 2], 1e-6)
    slopes = cam[:, :2] / depth[:, None]
    by_pose, by_point = np.zeros((len(cam), 2, 6)), np.empty((len(cam), 2, 3))
    for axis in range(2):
        scale, slope = K[axis, axis] / depth, slopes[:, axis]
        by_pose[:, axis, 3 + axis] = scale
        by_pose[:, axis, 5] = -scale * slope
        by_point[:, axis] = scale[:, None] * (rotation[:, axis] - slope[:, None] * rotation[:, 2])
    # The spoke from the object's origin to the point, crossed with the row of the shift.
    scale, slope = K[0, 0] / depth, slopes[:, 0]
    by_pose[:, 0, :3] = np.stack(
        [-down * scale * slope, ahead * scale + right * scale * slope, -down * scale], axis=1
    )
    scale, slope = K[1, 1] / depth, slopes[:, 1]
    by_pose[:, 1, :3] = np.stack(
        [-down * scale * slope - ahead * scale, right * scale * slope, right * scale], axis=1
    )
    return slopes * (K[0, 0], K[1, 1]) + K[:2, 2] - bundle.pixels, by_pose, by_point


def _products(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The transposes of `left` [M, 2, A] times `right` [M, 2, B]: [M, A, B]."""
    return left[:, 0, :, None] * right[:, 0, None, :] + left[:, 1, :, None] * right[:, 1, None, :]


def _add_prior(
    poses: np.ndarray,
    gradient: np.ndarray,
    bundle: Bundle,
    config: BundleConfig,
    free: np.ndarray,
    slot: np.ndarray,
) -> None:
    """Add the prior's part in place. Steps are small, so turns are differenced as if they commuted."""
    depth = float(np.median(bundle.transl[:, 2]))
    scales = (1.0 / np.radians(config.turn_sigma), 1.0 / (config.shift_sigma * depth))
    for part, (values, scale) in enumerate(zip(_accelerations(bundle, config), scales, strict=True)):
        weights = _soft((values**2).sum(1))[1]
        columns = slice(3 * part, 3 * part + 3)
        for middle, (value, weight) in enumerate(zip(values, weights, strict=True), start=1):
            for i, a in enumerate((middle - 1, middle, middle + 1)):
                if not free[a]:
                    continue
                gradient[slot[a], columns] += weight * _SECOND[i] * scale * value
                for j, b in enumerate((middle - 1, middle, middle + 1)):
                    if free[b]:
                        block = poses[slot[a], columns, slot[b], columns]
                        block[np.arange(3), np.arange(3)] += weight * _SECOND[i] * _SECOND[j] * scale**2


# Coefficients of a second difference.
_SECOND = (1.0, -2.0, 1.0)


def _step(bundle: Bundle, system: _System, free: np.ndarray, damping: float) -> Bundle:
    """One damped Gauss-Newton step."""
    reduced, scaled, inverse = _reduced(system, damping)
    frames = int(free.sum())
    right = scaled @ system.point_gradient.ravel() - system.pose_gradient
    change = scipy.linalg.solve(reduced, right, assume_a="sym")
    pull = (system.coupling.T @ change).reshape(-1, 3) + system.point_gradient
    moved = -np.einsum("nij,nj->ni", inverse, pull)
    change = change.reshape(frames, 6)
    rotations, transl = bundle.rotations.copy(), bundle.transl.copy()
    rotations[free] = Rotation.from_rotvec(change[:, :3]).as_matrix() @ rotations[free]
    transl[free] += change[:, 3:]
    return bundle._replace(rotations=rotations, transl=transl, points=bundle.points + moved)


def _reduced(system: _System, damping: float) -> tuple[np.ndarray, scipy.sparse.bsr_matrix, np.ndarray]:
    """The poses' equations without the points, the coupling times the points' inverse blocks, and those."""
    index = np.arange(3)
    points = system.points.copy()
    points[:, index, index] *= 1.0 + damping
    points[:, index, index] += 1e-9 * (1.0 + np.trace(points, axis1=1, axis2=2))[:, None]
    inverse = np.linalg.inv(points)
    poses = system.poses.copy()
    poses[np.diag_indices_from(poses)] *= 1.0 + damping
    poses[np.diag_indices_from(poses)] += 1e-9
    coupling = system.coupling
    scaled = scipy.sparse.bsr_matrix(
        (coupling.data @ inverse[coupling.indices], coupling.indices, coupling.indptr),
        shape=coupling.shape,
        blocksize=(6, 3),
    )
    return poses - (scaled @ coupling.T).toarray(), scaled, inverse


def _sum_by(index: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Sums [count, ...] of the rows of `values` [M, ...] that have the same `index` [M]."""
    matrix = scipy.sparse.csr_matrix(
        (np.ones(len(index)), (index, np.arange(len(index)))), shape=(count, len(index))
    )
    return (matrix @ values.reshape(len(index), int(np.prod(values.shape[1:])))).reshape(
        count, *values.shape[1:]
    )

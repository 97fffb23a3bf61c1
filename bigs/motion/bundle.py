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
from scipy.spatial.transform import Rotation

from bigs.motion.schur import (
    Observations,
    Scene,
    System,
    cost_of_pixels,
    linearise,
    point_steps,
    pose_steps,
    reduce,
    sort_observations,
)


@dataclass(frozen=True)
class BundleConfig:
    """Scales of the Cauchy losses, and when to stop."""

    pixel_sigma: float = 0.25  # standard deviation of a feature's reprojection error, pixels
    turn_sigma: float = 0.3  # the same of the change of angular velocity, degrees per frame and frame
    shift_sigma: float = 0.0015  # the same of the change of velocity, in depths per frame and frame
    # Given poses lose weight beyond this many standard deviations.
    anchor_outlier: float = 3.0
    iterations: int = 15
    # Stop if a step lowers the cost by less than this share.
    tolerance: float = 1e-4


class Bundle(NamedTuple):
    """Poses of consecutive frames, points, and what was seen where."""

    rotations: np.ndarray  # [T, 3, 3] object to camera
    transl: np.ndarray  # [T, 3]
    points: np.ndarray  # [N, 3]
    frame: np.ndarray  # [M] frame of each observation
    point: np.ndarray  # [M] point of each observation
    pixels: np.ndarray  # [M, 2]
    precision: np.ndarray  # [M, 3] inverse covariances (xx, xy, yy) of these, in units of 1 / pixel_sigma²

    def residuals(self, K: np.ndarray) -> np.ndarray:
        """Reprojection errors [M, 2] in pixels; huge where a point is behind the camera."""
        return _project(_in_camera(self), K) - self.pixels

    def depths(self) -> np.ndarray:
        """Depth [M] of every observed point in its frame."""
        return _in_camera(self)[:, 2]


def alike(count: int) -> np.ndarray:
    """The precision [count, 3] of observations whose errors are `pixel_sigma` in every direction."""
    return np.tile([1.0, 0.0, 1.0], (count, 1))


class Anchor(NamedTuple):
    """Poses known before, and how well; they hold what the observations leave open, the gauge too."""

    rotations: np.ndarray  # [T, 3, 3] object to camera
    transl: np.ndarray  # [T, 3]
    trust: np.ndarray  # [T] in [0, 1]; a frame of 0 has none
    turn_sigma: float  # standard deviation about each axis, radians
    shift_sigma: np.ndarray  # [3] standard deviations along the camera's axes


def adjust(
    bundle: Bundle,
    K: np.ndarray,
    config: BundleConfig,
    *,
    free: np.ndarray | None = None,
    anchor: Anchor | None = None,
) -> Bundle:
    """Minimise reprojection errors under the motion prior.

    Args:
        bundle: start values. A frame without observations is placed by the motion prior alone.
        K: [3, 3] intrinsics.
        config: see there.
        free: [T] bool, frames whose pose may change; all by default.
        anchor: poses known before, by Geman-McClure's loss.

    Returns:
        The adjusted bundle; without an anchor its gauge (pose and size of the object frame) is free to drift
        a little.
    """
    free = np.ones(len(bundle.rotations), dtype=bool) if free is None else free
    problem = make_problem(bundle, K, config, free, anchor)
    damping = 1e-3
    cost = cost_of(problem, bundle)
    for _ in range(config.iterations):
        system = linearise_all(problem, bundle)
        for _ in range(6):
            candidate = _step(problem, bundle, system, damping)
            new_cost = cost_of(problem, candidate)
            if new_cost < cost:
                break
            damping *= 8.0
        else:
            return bundle
        gain, cost, bundle, damping = cost - new_cost, new_cost, candidate, max(damping / 6.0, 1e-7)
        if gain < config.tolerance * cost:
            break
    return bundle


def pose_covariances(bundle: Bundle, K: np.ndarray, config: BundleConfig, anchor: Anchor) -> np.ndarray:
    """Covariance [T, 6, 6] of each frame's turn (radians) and shift (the unit of `transl`).

    To first order, from observations, motion prior and anchor. A turn, shift or growth of the object's frame
    itself has no part in it: it changes all poses alike and leaves the pictures alone.
    """
    frames = len(bundle.rotations)
    problem = make_problem(bundle, K, config, np.ones(frames, dtype=bool), anchor)
    matrix = reduce(linearise_all(problem, bundle), problem.seen, 0.0).matrix
    covariance = np.linalg.inv(matrix)
    # The gauge's effect on all poses: seven columns, weighted so that well-known frames fix it.
    gauge = np.zeros((frames, 6, 7))
    gauge[:, :3, :3] = bundle.rotations
    gauge[:, 3:, 3:6] = bundle.rotations
    gauge[:, 3:, 6] = bundle.transl
    columns = gauge.reshape(6 * frames, 7)
    weighted = columns / np.diag(covariance)[:, None]
    off = columns @ np.linalg.solve(columns.T @ weighted, weighted.T)
    rest = np.eye(6 * frames) - off
    blocks = (rest @ covariance @ rest.T).reshape(frames, 6, frames, 6)
    return np.einsum("titj->tij", blocks)


def turn_uncertainties(bundle: Bundle, K: np.ndarray, config: BundleConfig) -> np.ndarray:
    """Standard deviation of each frame's rotation against that of every other, [T, T] degrees.

    To first order, for independent reprojection errors of `config.pixel_sigma`. The gauge has no part in it.
    """
    free = np.ones(len(bundle.rotations), dtype=bool)
    problem = make_problem(bundle, K, config, free, None)
    reduced = reduce(linearise_all(problem, bundle), problem.seen, 0.0)
    covariance = np.linalg.pinv(reduced.matrix, rcond=1e-10, hermitian=True)
    blocks = covariance.reshape(len(free), 6, len(free), 6)[:, :3, :, :3]
    own = np.einsum("titi->t", blocks)
    # A rotation of frame s by d is seen in frame t as the same rotation of the object, carried along.
    carry = np.einsum("tij,skj->tsik", bundle.rotations, bundle.rotations)
    cross = np.einsum("tisj,tsij->ts", blocks, carry)
    return np.degrees(np.sqrt((own[:, None] + own - 2.0 * cross).clip(0.0)))


class Problem(NamedTuple):
    """What stays the same from step to step."""

    seen: Observations
    free: np.ndarray  # [T] bool, frames whose pose may change
    K: np.ndarray
    config: BundleConfig
    anchor: Anchor | None


def make_problem(
    bundle: Bundle, K: np.ndarray, config: BundleConfig, free: np.ndarray, anchor: Anchor | None
) -> Problem:
    """What `adjust` minimises, with its arguments; `cost_of` and `linearise_all` evaluate it."""
    seen = sort_observations(bundle.frame, bundle.point, bundle.pixels, bundle.precision, free)
    return Problem(seen, free, K, config, anchor)


def scene_of(problem: Problem, bundle: Bundle) -> Scene:
    """Where `bundle` has everything, its points by rank."""
    points = bundle.points[problem.seen.points]
    return Scene(bundle.rotations, bundle.transl, points, problem.K, problem.config.pixel_sigma)


def _in_camera(bundle: Bundle) -> np.ndarray:
    points = bundle.points[bundle.point]
    return np.einsum("mij,mj->mi", bundle.rotations[bundle.frame], points) + bundle.transl[bundle.frame]


def _project(cam: np.ndarray, K: np.ndarray) -> np.ndarray:
    depth = np.where(cam[:, 2] > 1e-6, cam[:, 2], 1e-6)
    return cam[:, :2] / depth[:, None] * (K[0, 0], K[1, 1]) + K[:2, 2]


def _soft(squared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Loss and weight of squared norms in units of their scale.

    The loss grows like the norm itself: a real change of motion costs, but is not free.
    """
    root = np.sqrt(1.0 + squared)
    return 2.0 * (root - 1.0), 1.0 / root


def _leaving(squared: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """The same for Geman-McClure's loss: what is off by many times `scale` pulls no more."""
    share = 1.0 / (1.0 + squared / scale**2)
    return squared * share, share**2


def cost_of(problem: Problem, bundle: Bundle) -> float:
    """The sum of all losses, twice the negative logarithm of a likelihood."""
    config = problem.config
    pixels = cost_of_pixels(problem.seen, scene_of(problem, bundle))
    turn, shift = _accelerations(bundle, config)
    total = pixels + _soft((turn**2).sum(1))[0].sum() + _soft((shift**2).sum(1))[0].sum()
    if problem.anchor is not None:
        for values in _departures(bundle, problem.anchor):
            total += problem.anchor.trust @ _leaving((values**2).sum(1), config.anchor_outlier)[0]
    return float(total)


def _departures(bundle: Bundle, anchor: Anchor) -> tuple[np.ndarray, np.ndarray]:
    """Turns and shifts [T, 3] from the anchor's poses, in units of their scales."""
    turn = Rotation.from_matrix(bundle.rotations @ anchor.rotations.transpose(0, 2, 1)).as_rotvec()
    return turn / anchor.turn_sigma, (bundle.transl - anchor.transl) / anchor.shift_sigma


def _accelerations(bundle: Bundle, config: BundleConfig) -> tuple[np.ndarray, np.ndarray]:
    """Second differences of rotation and position [T - 2, 3], in units of their scales."""
    steps = bundle.rotations[1:] @ bundle.rotations[:-1].transpose(0, 2, 1)
    velocity = Rotation.from_matrix(steps).as_rotvec()
    depth = float(np.median(bundle.transl[:, 2]))
    return (
        np.diff(velocity, axis=0) / np.radians(config.turn_sigma),
        np.diff(bundle.transl, 2, axis=0) / (config.shift_sigma * depth),
    )


def linearise_all(problem: Problem, bundle: Bundle) -> System:
    """Normal equations about `bundle`, the motion prior's part included."""
    frames = int(problem.free.sum())
    system = linearise(problem.seen, scene_of(problem, bundle))
    poses, gradient = system.poses.reshape(frames, 6, frames, 6), system.pose_gradient.reshape(frames, 6)
    _add_motion_prior(poses, gradient, bundle, problem)
    if problem.anchor is not None:
        _add_anchor(poses, gradient, bundle, problem, problem.anchor)
    return system


def _add_motion_prior(poses: np.ndarray, gradient: np.ndarray, bundle: Bundle, problem: Problem) -> None:
    """Add the motion prior's part in place. Steps are small, so turns are differenced as if they commuted."""
    config, free = problem.config, problem.free
    depth = float(np.median(bundle.transl[:, 2]))
    scales = (1.0 / np.radians(config.turn_sigma), 1.0 / (config.shift_sigma * depth))
    slot = np.cumsum(free) - 1
    first = np.arange(max(len(free) - 2, 0))  # of three frames, whose poses are differenced
    for part, (values, scale) in enumerate(zip(_accelerations(bundle, config), scales, strict=True)):
        columns = np.arange(3 * part, 3 * part + 3)
        weights = _soft((values**2).sum(1))[1][:, None]
        for i, own in enumerate(_SECOND):
            here = free[first + i]
            gradient[slot[first + i][here][:, None], columns] += (weights * own * scale * values)[here]
            for j, other in enumerate(_SECOND):
                both = here & free[first + j]
                a, b = slot[first + i][both][:, None], slot[first + j][both][:, None]
                poses[a, columns, b, columns] += weights[both] * own * other * scale**2


def _add_anchor(
    poses: np.ndarray, gradient: np.ndarray, bundle: Bundle, problem: Problem, anchor: Anchor
) -> None:
    """Add the anchor's part in place."""
    free = problem.free
    slot = np.arange(int(free.sum()))[:, None]
    scales = (np.full(3, 1.0 / anchor.turn_sigma), 1.0 / anchor.shift_sigma)
    for part, (values, scale) in enumerate(zip(_departures(bundle, anchor), scales, strict=True)):
        columns = np.arange(3 * part, 3 * part + 3)
        weights = anchor.trust * _leaving((values**2).sum(1), problem.config.anchor_outlier)[1]
        gradient[slot, columns] += (weights[:, None] * scale * values)[free]
        poses[slot, columns, slot, columns] += (weights[:, None] * scale**2)[free]


# Coefficients of a second difference.
_SECOND = (1.0, -2.0, 1.0)


def _step(problem: Problem, bundle: Bundle, system: System, damping: float) -> Bundle:
    """One damped Gauss-Newton step."""
    reduced = reduce(system, problem.seen, damping)
    change = pose_steps(reduced)
    rotations, transl, points = bundle.rotations.copy(), bundle.transl.copy(), bundle.points.copy()
    free = problem.free
    rotations[free] = Rotation.from_rotvec(change[:, :3]).as_matrix() @ rotations[free]
    transl[free] += change[:, 3:]
    points[problem.seen.points] += point_steps(system, reduced, problem.seen, change)
    return bundle._replace(rotations=rotations, transl=transl, points=points)

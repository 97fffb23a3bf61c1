"""Normal equations of reprojection errors with the points eliminated (Schur complement).

The arithmetic is the compiled engine's, `rust/track/src/bundle`; here are its arrays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg

from bigs import _raster


class Observations(NamedTuple):
    """What was seen where."""

    sightings: _raster.BundleSightings
    points: np.ndarray  # [P] the caller's number of each observed point; a point's rank is its place here


class System(NamedTuple):
    """Normal equations of F poses and P points."""

    poses: np.ndarray  # [6F, 6F]
    pose_gradient: np.ndarray  # [6F]
    points: np.ndarray  # [P, 3, 3]
    point_gradient: np.ndarray  # [P, 3]
    couplings: np.ndarray  # [M, 12] of each observation's point with its pose, as the engine keeps them


class Reduced(NamedTuple):
    """The poses' equations without the points."""

    matrix: np.ndarray  # [6F, 6F]
    gradient: np.ndarray  # [6F]
    inverses: np.ndarray  # [P, 3, 3] of the points' damped matrices; 0 where there is none


class Border(NamedTuple):
    """The focal length's part of the normal equations, for the logarithm of a factor on it."""

    poses: np.ndarray  # [6F] its coupling with the poses
    points: np.ndarray  # [P, 3] with the points, by rank
    stiffness: float
    gradient: float


class Scene(NamedTuple):
    """Where everything is thought to be."""

    rotations: np.ndarray  # [T, 3, 3] object to camera
    transl: np.ndarray  # [T, 3]
    points: np.ndarray  # [P, 3] by rank
    K: np.ndarray  # [3, 3]
    sigma: float  # scale of Cauchy's loss, pixels


def sort_observations(
    frame: np.ndarray, point: np.ndarray, pixels: np.ndarray, precision: np.ndarray, free: np.ndarray
) -> Observations:
    """Observations [M] by points, first those that are seen first; so neighbours are seen in the same frames.

    Args:
        frame, point, pixels, precision: [M], [M], [M, 2] and [M, 3]. A frame may have seen a point twice.
        free: [T] bool, frames that may move.
    """
    points, rank = np.unique(point, return_inverse=True)
    first = np.full(len(points), len(free))
    np.minimum.at(first, rank, frame)
    last = np.zeros(len(points), dtype=int)
    np.maximum.at(last, rank, frame)
    by_time = np.lexsort((last, first))
    place = np.empty_like(by_time)
    place[by_time] = np.arange(len(by_time))
    rank = place[rank]
    order = np.lexsort((frame, rank))
    sightings = _raster.BundleSightings(
        frame[order].astype(np.int64),
        rank[order].astype(np.int64),
        _plain(pixels[order]),
        _plain(precision[order]),
        np.ascontiguousarray(free),
    )
    return Observations(sightings, points[by_time])


def cost_of_pixels(seen: Observations, scene: Scene) -> float:
    """The sum of Cauchy's losses of all reprojection errors."""
    return seen.sightings.cost(_arrays(scene), scene.sigma)


def linearise(seen: Observations, scene: Scene) -> System:
    """Normal equations under Cauchy's loss.

    A pose changes by a turn about the object's origin, x_cam = exp(turn) R x + t, and then by a shift.
    """
    poses, pose_gradient, points, point_gradient, couplings = seen.sightings.linearise(
        _arrays(scene), scene.sigma
    )
    unknowns = len(pose_gradient)
    return System(
        poses.reshape(unknowns, unknowns),
        pose_gradient,
        points.reshape(-1, 3, 3),
        point_gradient.reshape(-1, 3),
        couplings.reshape(-1, 12),
    )


def focal_border(seen: Observations, scene: Scene) -> Border:
    """The focal length's part of the same equations."""
    poses, points, stiffness, gradient = seen.sightings.border(_arrays(scene), scene.sigma)
    return Border(poses, points.reshape(-1, 3), stiffness, gradient)


def reduce(system: System, seen: Observations, damping: float) -> Reduced:
    """Eliminate the points, after Levenberg's and Marquardt's `damping` of all equations."""
    rows = system._replace(points=system.points.reshape(-1, 9))
    matrix, gradient, inverses = seen.sightings.reduce(rows, damping)
    return Reduced(matrix.reshape(system.poses.shape), gradient, inverses.reshape(-1, 3, 3))


def pose_steps(reduced: Reduced) -> np.ndarray:
    """How far every pose [F, 6] goes."""
    try:
        # Half the time of a solution that allows for negative directions, of which damping leaves none but
        # by rounding.
        steps = scipy.linalg.solve(reduced.matrix, -reduced.gradient, assume_a="pos")
    except np.linalg.LinAlgError:
        steps = scipy.linalg.solve(reduced.matrix, -reduced.gradient, assume_a="sym")
    return steps.reshape(-1, 6)


def point_steps(system: System, reduced: Reduced, seen: Observations, change: np.ndarray) -> np.ndarray:
    """How far every point [P, 3] goes, by rank, when the poses go by `change` [F, 6]."""
    steps = seen.sightings.point_steps(
        system.couplings, system.point_gradient, reduced.inverses.reshape(-1, 9), _plain(change)
    )
    return steps.reshape(-1, 3)


def carried(system: System, seen: Observations, values: np.ndarray) -> np.ndarray:
    """What `values` [P, 3] of the points, by rank, do in the poses' equations [6F]."""
    return seen.sightings.carried(system.couplings, _plain(values))


def _plain(values: np.ndarray) -> np.ndarray:
    """Doubles without gaps, as the engine reads them."""
    return np.ascontiguousarray(values, dtype=np.float64)


def _arrays(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[float, float, float, float]]:
    K = scene.K
    return (
        _plain(scene.rotations).reshape(-1, 9),
        _plain(scene.transl),
        _plain(scene.points),
        (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])),
    )

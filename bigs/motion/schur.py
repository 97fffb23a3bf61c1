"""Normal equations of reprojection errors with the points eliminated, for points that many frames see.

A point that F frames see couples all of them: its part of the poses' equations has 36 F² numbers. Points are
taken in batches that are seen in much the same frames. The couplings of a batch fill one dense matrix, and
the product of that with itself, which a BLAS makes at full speed, is the batch's part. Within a batch each
number of a small matrix is an array over the observations, since numpy spends more time on starting products
of small matrices than on these.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

# Smallest number of observations of a batch: few enough that arrays over them stay in the cache.
_BATCH = 8_000

_Numbers = Sequence[np.ndarray] | np.ndarray  # coordinates of a vector or of a row, each [m]


class Observations(NamedTuple):
    """What was seen where, by points of which all observations are consecutive."""

    order: np.ndarray  # [M] index of each among the caller's observations
    frame: np.ndarray  # [M]
    point: np.ndarray  # [M] rank of the point
    pixels: np.ndarray  # [2, M]
    precision: np.ndarray  # [3, M]: inverse covariances (xx, xy, yy) in units of 1 / sigma²
    points: np.ndarray  # [P] the caller's number of each observed point
    batches: list[_Batch]


class _Batch(NamedTuple):
    """Some points with all their observations."""

    rows: slice  # range of observations
    points: slice  # range of ranks
    starts: np.ndarray  # [n] where each point's observations begin within the batch
    moving: np.ndarray  # [m] observations within the batch in frames that may move
    slots: np.ndarray  # [F] the frames that may move, by their index in the poses' equations
    slot: np.ndarray  # [m] index of each such observation's frame among these
    # A frame may have seen a point twice; such observations are one pair of point and frame.
    pairs: np.ndarray  # [p] where each pair's observations begin among those that may move
    pair_slot: np.ndarray  # [p] index of each pair's frame among the slots
    pair_point: np.ndarray  # [p] index of its point within the batch


class PointPart(NamedTuple):
    """A batch's part of the normal equations that has to do with points."""

    matrix: np.ndarray  # [n, 3, 3]
    gradient: np.ndarray  # [n, 3]
    coupling: np.ndarray  # [6, 3, p] of the pairs of a point and a frame that may move


class System(NamedTuple):
    """Normal equations: those of the poses, and for each batch those of its points."""

    poses: np.ndarray  # [6F, 6F]
    pose_gradient: np.ndarray  # [6F]
    parts: list[PointPart]


class Reduced(NamedTuple):
    """The poses' equations without the points."""

    matrix: np.ndarray  # [6F, 6F]
    gradient: np.ndarray  # [6F]
    inverses: list[np.ndarray]  # [n, 3, 3] of each batch's points


def sort_observations(
    frame: np.ndarray, point: np.ndarray, pixels: np.ndarray, precision: np.ndarray, free: np.ndarray
) -> Observations:
    """Observations [M] in batches of points that are first seen in about the same frame.

    Args:
        frame, point, pixels, precision: [M], [M], [M, 2] and [M, 3].
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
    frame, rank = frame[order], rank[order]
    ends = np.cumsum(np.bincount(rank, minlength=len(points)))
    slots = np.cumsum(free) - 1
    batches, began, row = [], 0, 0
    while began < len(points):
        # Also at least as many points as frames, since a batch contributes to all pairs of its frames.
        until = max(int(np.searchsorted(ends, row + _BATCH)) + 1, began + len(free))
        until = min(until, len(points))
        rows = slice(row, int(ends[until - 1]))
        here = np.flatnonzero(free[frame[rows]])
        used, slot = np.unique(slots[frame[rows][here]], return_inverse=True)
        starts = np.concatenate([[row], ends[began : until - 1]]) - row
        owner = rank[rows][here] - began
        pairs = np.flatnonzero(np.diff(owner, prepend=-1) | np.diff(slot, prepend=-1))
        batches.append(
            _Batch(rows, slice(began, until), starts, here, used, slot, pairs, slot[pairs], owner[pairs])
        )
        began, row = until, rows.stop
    pixels, precision = (np.ascontiguousarray(values[order].T) for values in (pixels, precision))
    return Observations(order, frame, rank, pixels, precision, points[by_time], batches)


def linearise(
    seen: Observations,
    rotations: np.ndarray,
    transl: np.ndarray,
    points: np.ndarray,
    K: np.ndarray,
    sigma: float,
    frames: int,
) -> System:
    """Normal equations under Cauchy's loss of scale `sigma` pixels.

    A pose changes by a turn about the object's origin, x_cam = exp(turn) R x + t, and then by a shift.

    Args:
        seen: of T frames, of which `frames` may move.
        rotations, transl: [T, 3, 3] and [T, 3] object to camera.
        points: [P, 3] by rank.
        K: [3, 3].
        sigma: pixels.
        frames: F.
    """
    poses = np.zeros((6, 6, frames))
    gradient = np.zeros((6, frames))
    parts = []
    for batch in seen.batches:
        rotation = rotations.transpose(1, 2, 0)[:, :, seen.frame[batch.rows]]
        spoke = _times(rotation, points.T[:, seen.point[batch.rows]])
        place = [a + b for a, b in zip(spoke, transl.T[:, seen.frame[batch.rows]], strict=True)]
        hessian, pull = _by_place(place, seen.pixels[:, batch.rows], seen.precision[:, batch.rows], K, sigma)
        turned = [_times(np.transpose(rotation, (1, 0, 2)), row) for row in hessian]  # rows of hessian @ R
        matrix = np.empty((len(batch.starts), 3, 3))
        by_point = np.empty((len(batch.starts), 3))
        for i in range(3):
            by_point[:, i] = np.add.reduceat(_dot(rotation[:, i], pull), batch.starts)
            for j in range(i + 1):
                values = _dot(rotation[:, i], [row[j] for row in turned])
                matrix[:, i, j] = matrix[:, j, i] = np.add.reduceat(values, batch.starts)
        at = batch.moving
        arm = [a[at] for a in spoke]
        coupling = np.empty((6, 3, len(at)))
        for i in range(3):
            coupling[3 + i] = [a[at] for a in turned[i]]
        for j in range(3):
            coupling[:3, j] = _cross(arm, coupling[3:, j])
        if len(batch.pairs) < len(at):
            coupling = np.add.reduceat(coupling, batch.pairs, axis=2)
        parts.append(PointPart(matrix, by_point, coupling))
        slot = batch.slots[batch.slot]
        _add_poses(
            poses, gradient, slot, arm, [[a[at] for a in row] for row in hessian], [a[at] for a in pull]
        )
    lower = np.tril_indices(6, -1)
    poses[lower[1], lower[0]] = poses[lower]
    whole = np.zeros((frames, 6, frames, 6))
    diagonal = np.arange(frames)
    whole[diagonal, :, diagonal, :] = poses.transpose(2, 0, 1)
    return System(whole.reshape(6 * frames, 6 * frames), gradient.T.ravel(), parts)


def _by_place(
    place: _Numbers, pixels: np.ndarray, precision: np.ndarray, K: np.ndarray, sigma: float
) -> tuple[list[list[np.ndarray]], list[np.ndarray]]:
    """Second and first derivatives [3][3] and [3] of the losses by places in the camera's frame."""
    z = np.where(place[2] > 1e-6, place[2], 1e-6)
    u, v = place[0] / z, place[1] / z
    wide, high = K[0, 0] / z, K[1, 1] / z
    off = K[0, 0] * u + K[0, 2] - pixels[0], K[1, 1] * v + K[1, 2] - pixels[1]
    (xx, xy, yy), (right, below) = pulled(precision, off, sigma)
    xx, xy, yy = wide**2 * xx, wide * high * xy, high**2 * yy
    far_x, far_y = -(u * xx + v * xy), -(u * xy + v * yy)
    right, below = wide * right, high * below
    hessian = [[xx, xy, far_x], [xy, yy, far_y], [far_x, far_y, -(u * far_x + v * far_y)]]
    return hessian, [right, below, -u * right - v * below]


def pulled(precision: np.ndarray, off: _Numbers, sigma: float) -> tuple[_Numbers, list[np.ndarray]]:
    """Second derivatives (xx, xy, yy) and first ones [2] of Cauchy losses by pixels, halved.

    Args:
        precision: [3, M] of the observations, in units of 1 / `sigma`².
        off: [2, M] reprojection errors in pixels.
        sigma: pixels.
    """
    xx, xy, yy = precision
    right, below = xx * off[0] + xy * off[1], xy * off[0] + yy * off[1]
    weight = 1.0 / (sigma**2 + right * off[0] + below * off[1])
    return weight * precision, [weight * right, weight * below]


def _add_poses(
    poses: np.ndarray,
    gradient: np.ndarray,
    slot: np.ndarray,
    arm: _Numbers,
    hessian: Sequence[Sequence[np.ndarray]],
    pull: _Numbers,
) -> None:
    """Add to the lower half of the poses' blocks [6, 6, F], and to their gradient [6, F], in place.

    `slot` [m] is the pose of each observation, `arm` the spoke from the object's origin to what was seen.
    """
    sums = lambda values: np.bincount(slot, values, poses.shape[2])  # noqa: E731
    levers = [_cross(arm, row) for row in hessian]  # of a shift relative to a rotation
    rows = [*_columns_crossed(arm, levers), *levers]
    for i, value in enumerate((*_cross(arm, pull), *pull)):
        gradient[i] += sums(value)
    for i in range(6):
        for j in range(min(i, 2) + 1):
            poses[i, j] += sums(rows[i][j])
    for i in range(3):
        for j in range(i + 1):
            poses[3 + i, 3 + j] += sums(hessian[i][j])


def reduce(system: System, seen: Observations, damping: float) -> Reduced:
    """Eliminate the points, after Levenberg's and Marquardt's `damping` of all equations."""
    frames = len(system.pose_gradient) // 6
    matrix = system.poses.copy()
    matrix[np.diag_indices_from(matrix)] *= 1.0 + damping
    matrix[np.diag_indices_from(matrix)] += 1e-9
    gradient = system.pose_gradient.copy()
    inverses = []
    index = np.arange(3)
    for batch, part in zip(seen.batches, system.parts, strict=True):
        points = part.matrix.copy()
        points[:, index, index] *= 1.0 + damping
        points[:, index, index] += 1e-9 * (1.0 + np.trace(points, axis1=1, axis2=2))[:, None]
        inverse = np.linalg.inv(points)
        inverses.append(inverse)
        width = 6 * len(batch.slots)
        if width == 0:
            continue
        dense = np.zeros((len(points), 3, width))
        blocks = dense.reshape(len(points), 3, len(batch.slots), 6)
        blocks[batch.pair_point, :, batch.pair_slot, :] = part.coupling.transpose(2, 1, 0)
        # inverse = root rootᵀ, so that a single product of a matrix with itself remains.
        root = np.linalg.cholesky(0.5 * (inverse + inverse.transpose(0, 2, 1)))
        scaled = (root.transpose(0, 2, 1) @ dense).reshape(-1, width)
        columns = (6 * batch.slots[:, None] + np.arange(6)).ravel()
        pulls = np.einsum("nji,nj->ni", root, part.gradient).ravel()
        gradient[columns] -= scaled.T @ pulls
        product = scaled.T @ scaled
        if len(batch.slots) == frames:
            matrix -= product
        else:
            matrix[np.ix_(columns, columns)] -= product
    return Reduced(matrix, gradient, inverses)


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
    steps = np.zeros((len(seen.points), 3))
    for batch, part, inverse in zip(seen.batches, system.parts, reduced.inverses, strict=True):
        pull = part.gradient.copy()
        step = change.T[:, batch.slots[batch.pair_slot]]
        for j in range(3):
            pull[:, j] += np.bincount(batch.pair_point, _dot(part.coupling[:, j], step), len(pull))
        steps[batch.points] = -np.einsum("nij,nj->ni", inverse, pull)
    return steps


def _dot(left: _Numbers, right: _Numbers) -> np.ndarray:
    total = left[0] * right[0]
    for a, b in zip(left[1:], right[1:], strict=True):
        total += a * b
    return total


def _times(matrix: _Numbers, vector: _Numbers) -> list[np.ndarray]:
    """Products of matrices [3][3] and vectors [3], each number [m]."""
    return [_dot(row, vector) for row in matrix]


def _cross(left: _Numbers, right: _Numbers) -> list[np.ndarray]:
    return [
        left[1] * right[2] - left[2] * right[1],
        left[2] * right[0] - left[0] * right[2],
        left[0] * right[1] - left[1] * right[0],
    ]


def _columns_crossed(left: _Numbers, rows: Sequence[Sequence[np.ndarray]]) -> list[list[np.ndarray]]:
    """Rows of the matrix whose columns are `left` crossed with those of the matrix of `rows`."""
    columns = [_cross(left, [row[j] for row in rows]) for j in range(3)]
    return [[column[i] for column in columns] for i in range(3)]

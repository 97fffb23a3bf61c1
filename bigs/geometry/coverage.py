"""Which parts of an object's surface a clip has seen, and from which directions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import bigs.fused.shape as fused

# Surface that is turned away further than this is seen at a glancing angle only, cosine.
_LEAST_COSINE = 0.2


@dataclass(frozen=True)
class ObjectViews:
    """The object's pixels in each frame, and its pose there."""

    shown: np.ndarray  # [T, H, W] bool: nothing hides the object here
    K: np.ndarray  # [3, 3] intrinsics
    rotations: np.ndarray  # [T, 3, 3]; x_cam = R x + centre
    centers: np.ndarray  # [T, 3] metres

    @property
    def poses(self) -> fused.Poses:
        """The same as the compiled code has it."""
        return fused.Poses(self.K, self.rotations, self.centers)

    def pixels(self, t: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Row, column [N] of the pixels of points [N, 3], their depths, and which are in the image."""
        cam = points @ self.rotations[t].T + self.centers[t]
        depth = np.maximum(cam[:, 2], 1e-6)
        pixels = np.floor(cam[:, :2] / depth[:, None] * self.K[[0, 1], [0, 1]] + self.K[:2, 2]).astype(int)
        height, width = self.shown.shape[1:]
        inside = (cam[:, 2] > 1e-3) & (pixels >= 0).all(1) & (pixels < (width, height)).all(1)
        column, row = np.where(inside[:, None], pixels, 0).T
        return row, column, cam[:, 2], inside

    def directions(self, t: int, points: np.ndarray) -> np.ndarray:
        """Unit directions [N, 3] from points [N, 3] to frame t's camera, object frame."""
        towards = -self.centers[t] @ self.rotations[t] - points
        return towards / np.linalg.norm(towards, axis=-1, keepdims=True)


class MeasuredPoints(NamedTuple):
    """Points of an object that were measured, and the lines of sight that measured them."""

    points: np.ndarray  # [N, 3] metres, object frame
    sightings: np.ndarray  # [M, 2] frame and index of points whose place is sure, each time they were seen


def times_seen(
    views: ObjectViews, points: np.ndarray, normals: np.ndarray, surface: np.ndarray, tolerance: float
) -> np.ndarray:
    """In how many frames [N] surface points show: they face the camera, and nothing hides them.

    Args:
        views: the clip's frames.
        points: [N, 3] metres, object frame.
        normals: [N, 3] unit, outward.
        surface: [M, 3] dense samples of the whole surface, which may hide the points.
        tolerance: metres that a point may lie behind the nearest surface of its pixel.
    """
    return fused.times_seen(views.shown, views.poses, points, normals, surface, _LEAST_COSINE, tolerance)


def seen_in(
    views: ObjectViews,
    t: int,
    points: np.ndarray,
    normals: np.ndarray,
    surface: np.ndarray,
    tolerance: float,
) -> np.ndarray:
    """Which surface points [N] (bool) show in frame `t`; arguments as for `times_seen`."""
    one = slice(t, t + 1)
    frame = ObjectViews(views.shown[one], views.K, views.rotations[one], views.centers[one])
    return times_seen(frame, points, normals, surface, tolerance) > 0


def times_empty(views: ObjectViews, points: np.ndarray, surface: np.ndarray, tolerance: float) -> np.ndarray:
    """In how many frames [N] points [N, 3] would hide, by more than `tolerance`, surface [M, 3] that shows.

    `surface` holds samples that the clip has seen, metres; what is in front of them cannot be there. A
    surface that is seen from one side is unseen from the other; where only that side lies behind, nothing is
    known.
    """
    return fused.times_empty(views.shown, views.poses, points, surface, tolerance)


def sphere_directions(count: int) -> np.ndarray:
    """`count` unit directions [count, 3], evenly spread (a Fibonacci spiral)."""
    steps = np.arange(count) + 0.5
    z = 1.0 - 2.0 * steps / count
    angle = np.pi * (1.0 + 5.0**0.5) * steps
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)


def coverage_by_direction(normals: np.ndarray, seen: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """How much [D] of what faces each direction [D, 3] has been seen, as a share of its projected area.

    Args:
        normals: [N, 3] of evenly spread surface samples.
        seen: [N] bool.
        directions: unit, object frame; the direction from the object to a camera.
    """
    facing = np.maximum(directions @ normals.T, 0.0)
    return (facing @ seen) / np.maximum(facing.sum(1), 1e-12)

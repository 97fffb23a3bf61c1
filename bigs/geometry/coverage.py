"""Which parts of an object's surface a clip has seen, and from which directions."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import torch

# Surface that is turned away further than this is seen at a glancing angle only, cosine.
_LEAST_COSINE = 0.2
# A sample also covers this many pixels of the depth buffer on either side, so that no gap shows what lies
# behind.
_CLOSED = 2


@dataclass(frozen=True)
class ObjectViews:
    """The object's pixels in each frame, and its pose there."""

    shown: np.ndarray  # [T, H, W] bool: nothing hides the object here
    K: np.ndarray  # [3, 3] intrinsics
    rotations: np.ndarray  # [T, 3, 3]; x_cam = R x + centre
    centers: np.ndarray  # [T, 3] metres

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

    def nearest_depths(self, t: int, points: np.ndarray) -> np.ndarray:
        """Depth buffer [H, W] of surface samples [N, 3]; infinite where there is none."""
        row, column, depth, inside = self.pixels(t, points)
        buffer = np.full(self.shown.shape[1:], np.inf)
        np.minimum.at(buffer, (row[inside], column[inside]), depth[inside])
        return scipy.ndimage.minimum_filter(buffer, 2 * _CLOSED + 1)


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
    return _over_frames(views, points, lambda t: seen_in(views, t, points, normals, surface, tolerance))


def seen_in(
    views: ObjectViews,
    t: int,
    points: np.ndarray,
    normals: np.ndarray,
    surface: np.ndarray,
    tolerance: float,
) -> np.ndarray:
    """Which surface points [N] (bool) show in frame `t`; arguments as for `times_seen`."""
    row, column, depth, inside = views.pixels(t, points)
    cosine = (views.directions(t, points) * normals).sum(-1)
    facing = cosine > _LEAST_COSINE
    # The buffer holds the nearest depth of some pixels around, which on a slope is nearer than the point's
    # own.
    slope = np.sqrt(1.0 - cosine.clip(_LEAST_COSINE, 1.0) ** 2) / cosine.clip(_LEAST_COSINE, 1.0)
    nearest = views.nearest_depths(t, surface)[row, column] + _CLOSED * depth / views.K[0, 0] * slope
    return inside & facing & views.shown[t, row, column] & (depth < nearest + tolerance)


def times_empty(views: ObjectViews, points: np.ndarray, surface: np.ndarray, tolerance: float) -> np.ndarray:
    """In how many frames [N] points [N, 3] would hide, by more than `tolerance`, surface [M, 3] that shows.

    `surface` holds samples that the clip has seen, metres; what is in front of them cannot be there.
    """

    def hiding(t: int) -> np.ndarray:
        row, column, depth, inside = views.pixels(t, points)
        # A surface that is seen from one side is unseen from the other; if only that side lies behind,
        # nothing is known.
        nearest = views.nearest_depths(t, surface)[row, column]
        return inside & views.shown[t, row, column] & np.isfinite(nearest) & (depth < nearest - tolerance)

    return _over_frames(views, points, hiding)


def _over_frames(views: ObjectViews, points: np.ndarray, holds: Callable[[int], np.ndarray]) -> np.ndarray:
    """In how many frames [N] something holds of points [N, 3]; frames are looked at side by side."""
    count = np.zeros(len(points), dtype=int)
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for of_frame in pool.map(holds, range(len(views.shown))):
            count += of_frame
    return count


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

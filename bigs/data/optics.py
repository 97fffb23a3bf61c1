"""Pictures as a pinhole camera would have taken them, from files that are cut out of those or distorted."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import map_coordinates

# Radii, as tangents of the angle to the axis, at which a lens is checked: no lens sees 87 degrees off axis.
_RADII = np.linspace(0.0, 20.0, 20_001)


@dataclass(frozen=True)
class Optics:
    """Where the pixels of a clip's files lie in the pinhole pictures that the clip is made of.

    A file shows a box of the whole picture, which the lens has distorted.
    """

    K: np.ndarray  # [3, 3] of the whole picture
    size: tuple[int, int]  # width, height of the whole picture
    file_size: tuple[int, int]  # width, height of every file
    boxes: np.ndarray  # [T, 4] left, top, right, bottom in pixels of the whole picture, may reach beyond it
    distortion: np.ndarray  # [8] k1 k2 p1 p2 k3 k4 k5 k6 of OpenCV's rational model; zeros for none

    def chosen(self, frames: np.ndarray) -> Optics:
        """Of the given frames only."""
        return replace(self, boxes=self.boxes[frames])

    def pinhole(self, t: int, pixels: np.ndarray, order: int) -> np.ndarray:
        """The whole pinhole picture of frame `t`; black where the file shows nothing.

        Args:
            t: the frame.
            pixels: [h, w] or [h, w, C] uint8, the file's.
            order: of the interpolation: 1 for colours, 0 for labels.

        Returns:
            [H, W] or [H, W, C] uint8.
        """
        left, top, right, bottom = self.boxes[t]
        width, height = self.file_size
        seen = _seen_points(tuple(self.K.ravel()), self.size, tuple(self.distortion))
        # Pixel centres at +0.5 in the picture and in the file.
        columns = (seen[..., 0] - left) * (width / (right - left)) - 0.5
        rows = (seen[..., 1] - top) * (height / (bottom - top)) - 0.5
        inside = (columns >= -0.5) & (columns <= width - 0.5) & (rows >= -0.5) & (rows <= height - 0.5)
        out = np.zeros((*inside.shape, *pixels.shape[2:]), dtype=np.uint8)
        places = np.stack([rows[inside], columns[inside]])
        for channel in np.ndindex(pixels.shape[2:]):
            values = map_coordinates(
                pixels[(..., *channel)], places, output=np.float32, order=order, mode="nearest"
            )
            out[(inside, *channel)] = np.rint(values).astype(np.uint8)
        return out


def distort(points: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Where a lens puts what a pinhole camera would have at `points` [..., 2] = (x / z, y / z).

    OpenCV's rational model with tangential terms. Beyond the radius at which a lens would fold the picture
    back onto itself there is nothing to see: NaN.
    """
    _, _, p1, p2, *_ = distortion
    x, y = points[..., 0], points[..., 1]
    r2 = x**2 + y**2
    radial = _radial(r2, distortion)
    bent = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        ],
        axis=-1,
    )
    falls = np.diff(_RADII * _radial(_RADII**2, distortion)) <= 0
    limit = _RADII[np.argmax(falls)] if falls.any() else np.inf
    bent[r2 >= limit**2] = np.nan
    return bent


def _radial(r2: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    k1, k2, _, _, k3, k4, k5, k6 = distortion
    with np.errstate(divide="ignore", invalid="ignore"):
        return (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))


@functools.lru_cache(maxsize=1)  # a clip's frames share it, and it is large
def _seen_points(K: tuple[float, ...], size: tuple[int, int], distortion: tuple[float, ...]) -> np.ndarray:
    """For each pixel of the pinhole picture where in the distorted one its content lies, [H, W, 2] pixels."""
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    if not any(distortion):
        return np.stack([columns, rows], axis=-1)
    matrix = np.reshape(K, (3, 3))
    pixels = np.stack([columns, rows, np.ones_like(columns)], axis=-1)
    rays = pixels @ np.linalg.inv(matrix).T
    bent = distort(rays[..., :2] / rays[..., 2:], np.array(distortion))
    return bent @ matrix[:2, :2].T + matrix[:2, 2]

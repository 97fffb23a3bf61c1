"""How a hand-held camera turns, told by a background that stands still.

A camera that shakes or sways turns more than it moves, and a turn shifts all that lies behind hands and
object as the camera's matrix says. So three angles a frame bring pictures to one. Gauss-Newton steps on
smoothed colours find them, in which what does not fit counts little.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.ndimage
from scipy.spatial.transform import Rotation

from bigs.threads import side_by_side

# Long side in pixels at which frames are aligned, blur in these pixels, and steps for a frame.
_SIZE, _BLUR, _STEPS = 160, 2.0, 10
# Steps end at a turn that moves no pixel by more than this share of one.
_STILL = 0.02
# What differs by much more than is usual, or at least by this much of [0, 1], does not fit.
_DIFFERS = 0.02
# Mask borders mix colours; so many pixels are left out.
_RIM = 2


class SteadyView(NamedTuple):
    """A picture that stands still and holds all that the frames of a turning camera see."""

    turns: np.ndarray  # [T, 3, 3] from its rays to those of each frame
    K: np.ndarray  # [3, 3] of the frames
    wide: np.ndarray  # [3, 3] of the picture
    shape: tuple[int, int]  # of the picture

    def gathered(self, values: np.ndarray) -> np.ndarray:
        """Frames' values [T, H, W, ...], uint8 or bool, where the picture shows them; 0 beyond."""
        pixels = (_turned_pixels(turn, self.K, self.wide, self.shape) for turn in self.turns)
        order = 0 if values.dtype == bool else 1
        return np.stack([_sampled(frame, at, order, 0) for frame, at in zip(values, pixels, strict=True)])

    def shown_in(self, t: int, values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """What frame `t`, of that shape, sees of the picture's values [h, w, ...]; not a number beyond."""
        return _sampled(values, _turned_pixels(self.turns[t].T, self.wide, self.K, shape), 1, np.nan)


def steady_view(images: np.ndarray, background: np.ndarray, K: np.ndarray) -> SteadyView:
    """How a camera turns before a background that stands still.

    Args:
        images: [T, H, W, 3] uint8.
        background: [T, H, W] bool, where they show what stands still, or may do.
        K: [3, 3] of the images.
    """
    turns = camera_turns(images, background, K)
    height, width = images.shape[1:3]
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]]) @ np.linalg.inv(K).T
    seen = np.einsum("tji,kj->tki", turns, corners) @ K.T  # turned back into the picture
    seen = seen[..., :2] / np.maximum(seen[..., 2:], 1e-6)
    low, high = np.floor(seen.min((0, 1))), np.ceil(seen.max((0, 1)))
    # A turn so large is none that was found: it would need a picture without end.
    low = np.maximum(low, -np.array([width, height]))
    high = np.minimum(high, 2 * np.array([width, height]))
    wide = K.copy()
    wide[:2, 2] -= low
    columns, rows = (high - low).astype(int)
    return SteadyView(turns, K, wide, (int(rows), int(columns)))


def camera_turns(images: np.ndarray, background: np.ndarray, K: np.ndarray) -> np.ndarray:
    """The turns [T, 3, 3] that carry rays of the middle frame to those of each frame that see the same.

    Args:
        images: [T, H, W, 3] uint8.
        background: [T, H, W] bool, where they show what stands still.
        K: [3, 3] of the images.
    """
    step = max(1, -(-max(images.shape[1:3]) // _SIZE))
    K = np.diag([1.0 / step, 1.0 / step, 1.0]) @ K
    frames = range(len(images))
    looks = np.stack(side_by_side(lambda t: _smoothed(images[t])[::step, ::step], frames))
    shown = np.stack(
        side_by_side(lambda t: scipy.ndimage.binary_erosion(background[t], iterations=_RIM), frames)
    )[:, ::step, ::step]
    middle = len(images) // 2
    turns = np.broadcast_to(np.eye(3), (len(images), 3, 3)).copy()
    # A frame starts where its neighbour ended.
    for order in (range(middle + 1, len(images)), range(middle - 1, -1, -1)):
        turn = np.eye(3)
        for t in order:
            turn = _aligned(looks[middle], shown[middle], looks[t], shown[t], K, turn)
            turns[t] = turn
    return turns


def _smoothed(image: np.ndarray) -> np.ndarray:
    return scipy.ndimage.gaussian_filter(image / np.float32(255.0), (_BLUR, _BLUR, 0.0))


def _turned_pixels(turn: np.ndarray, to: np.ndarray, of: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Where pixels of an image with matrix `of` lie in one with matrix `to` once their rays are turned.

    Returns:
        [2, h, w] rows and columns, which are whole at centres of pixels.
    """
    columns, rows = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    there = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ (to @ turn @ np.linalg.inv(of)).T
    depth = np.maximum(there[..., 2], 1e-6)
    return np.stack([there[..., 1] / depth - 0.5, there[..., 0] / depth - 0.5])


def _sampled(values: np.ndarray, pixels: np.ndarray, order: int, nothing: float) -> np.ndarray:
    """Values [H, W, ...] at rows and columns [2, h, w]: [h, w, ...]; order 0 takes the nearest."""
    channels = np.moveaxis(values.reshape(*values.shape[:2], -1), -1, 0)
    found = [
        scipy.ndimage.map_coordinates(channel, pixels, order=order, cval=nothing) for channel in channels
    ]
    return np.stack(found, axis=-1).reshape(*pixels.shape[1:], *values.shape[2:])


def _aligned(
    look: np.ndarray,
    shown: np.ndarray,
    other: np.ndarray,
    other_shown: np.ndarray,
    K: np.ndarray,
    turn: np.ndarray,
) -> np.ndarray:
    """The turn that makes another frame [h, w, 3] look like this one, from a first guess."""
    shape = shown.shape
    moves = _pixel_moves(K, shape)
    for _ in range(_STEPS):
        there = _turned_pixels(turn, K, K, shape)
        seen = _sampled(other, there, 1, 0.0)
        both = shown & _sampled(other_shown, there, 0, 0)
        if both.sum() < len(moves):
            return turn
        gaps = (seen - look)[both]
        size = np.abs(gaps).max(-1)
        scale = max(1.5 * np.median(size), _DIFFERS)
        weights = 1.0 / (1.0 + (size / scale) ** 2) ** 2
        slopes = np.stack(np.gradient(0.5 * (seen + look), axis=(0, 1)))[:, both]  # [2, n, 3]
        jacobian = np.einsum("knc,kna->nca", slopes, moves[:, both])
        weighted = weights[:, None, None] * jacobian
        normal = np.einsum("nca,ncb->ab", weighted, jacobian)
        # Before a plain wall every turn fits, and none is found.
        angles = -np.linalg.lstsq(normal, np.einsum("nca,nc->a", weighted, gaps))[0]
        turn = turn @ Rotation.from_rotvec(angles).as_matrix()
        if np.abs(moves.reshape(-1, 3) @ angles).max() < _STILL:
            break
    return turn


def _pixel_moves(K: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """How rows and columns of pixels move with the three angles of a small turn: [2, h, w, 3]."""
    columns, rows = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    across = K[0, 0] * np.stack([-x * y, 1.0 + x * x, -y], axis=-1)
    down = K[1, 1] * np.stack([-(1.0 + y * y), x * y, x], axis=-1)
    return np.stack([down, across])

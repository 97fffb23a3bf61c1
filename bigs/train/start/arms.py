"""Arms and sleeves before a background that moves.

An arm hides a hand's wrist, and masks call it background. Where that stands still, an arm is what differs.
Otherwise two things are known: an arm goes on from the wrist, and it has the same few colours in all frames,
which the background has no more often near a wrist than elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bigs.data.oddities.forearms import KNUCKLE
from bigs.train.start.color_counts import color_cells, color_counts, smoothed
from bigs.types import Side

# Where an arm may be, in metres: within these distances of the wrist and of a line that goes on from it, so
# far. Estimates of wrists err, elbows and sleeves are wide.
_CUFF_RADIUS, _CUFF_LENGTH = 0.05, 0.06
_ARM_RADIUS, _ARM_LENGTH = 0.08, 0.35
# All that is so near the line through a forearm is arm, ...
_SURE_RADIUS = 0.02
# ... if in the median frame more than this share of it differs from the background. Without an arm none does.
_SLEEVED = 0.15
# An arm has a colour if this percentage of its pixels have one that is rarer on it.
_RARE = 10.0
# Colours that are so many times as frequent near wrists as elsewhere are those of arms.
_TIMES = 2.0
# If less of what is near a wrist has such colours, they do not tell the arm from the background.
_LEAST_SHARE = 0.2
# A colour that was never seen counts as if this share of all pixels had it.
_NEVER = 1e-4


def arm_reach(joints: Mapping[Side, np.ndarray], K: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Which pixels of T images an arm may cover: bool of that shape, [T, H, W].

    Args:
        joints: [T, 21, 3] of each hand in camera space, as estimated.
        K: [3, 3] of the images.
        shape: of the images.
    """
    return _beyond_any(joints, K, shape, _ARM_RADIUS, _ARM_LENGTH)


def cuff_reach(joints: Mapping[Side, np.ndarray], K: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The same [T, H, W] next to the wrists."""
    return _beyond_any(joints, K, shape, _CUFF_RADIUS, _CUFF_LENGTH)


def arms(
    images: np.ndarray,
    background: np.ndarray,
    reach: np.ndarray,
    joints: Mapping[Side, np.ndarray],
    K: np.ndarray,
) -> np.ndarray:
    """Where arms and sleeves may hide a hand.

    Args:
        images: [T, H, W, 3] uint8.
        background: [T, H, W] bool, what no mask claims.
        reach: [T, H, W] bool, of `arm_reach`.
        joints, K: as there.

    Returns:
        [T, H, W] bool, part of the background. Where colours do not tell an arm, all of its cuff.
    """
    cuffs = [
        background & _beyond(places, K, background.shape, _CUFF_RADIUS, _CUFF_LENGTH)
        for places in joints.values()
    ]
    near = np.logical_or.reduce(cuffs) if cuffs else np.zeros_like(background)
    colored = _log_ratio(images, near, background & ~reach) > np.log(_TIMES)
    found = reach & background & colored
    for cuff in cuffs:
        if colored[cuff].sum() < _LEAST_SHARE * cuff.sum():
            found |= cuff
    return found


def cuffs_like_background(
    images: np.ndarray,
    differs: np.ndarray,
    background: np.ndarray,
    joints: Mapping[Side, np.ndarray],
    K: np.ndarray,
) -> np.ndarray:
    """Where arms and sleeves hide wrists although they have the colour of the background behind them.

    Args:
        images: [T, H, W, 3] uint8.
        differs: [T, H, W] bool, what of the background is not as usual.
        background: [T, H, W] bool, what no mask claims.
        joints, K: as of `arm_reach`.

    Returns:
        [T, H, W] bool: next to the wrists of hands whose arms show in most frames, what has an arm's colours.
    """
    found = np.zeros_like(background)
    for places in joints.values():
        cuff = background & _beyond(places, K, background.shape, _SURE_RADIUS, _CUFF_LENGTH)
        pixels = cuff.sum(axis=(1, 2))
        shares = (differs & cuff).sum(axis=(1, 2))[pixels > 0] / pixels[pixels > 0]
        if len(shares) and np.median(shares) > _SLEEVED:
            colors = images[differs & cuff] / np.float32(255.0)
            counts = color_counts(colors, np.ones(len(colors)))
            usual = np.percentile(counts[color_cells(colors)], _RARE)
            found[cuff] |= counts[color_cells(images[cuff] / np.float32(255.0))] >= usual
    return found


def _beyond_any(
    joints: Mapping[Side, np.ndarray], K: np.ndarray, shape: tuple[int, ...], radius: float, length: float
) -> np.ndarray:
    """`_beyond` of all hands."""
    found = np.zeros(shape, dtype=bool)
    for places in joints.values():
        found |= _beyond(places, K, shape, radius, length)
    return found


def _beyond(
    joints: np.ndarray, K: np.ndarray, shape: tuple[int, ...], radius: float, length: float
) -> np.ndarray:
    """Pixels [T, H, W] that see within `radius` of the line of `length` that goes on from a hand's wrist."""
    found = np.zeros(shape, dtype=bool)
    rows, columns = np.ogrid[: shape[1], : shape[2]]
    x, y = columns + 0.5, rows + 0.5
    wrist = joints[:, 0]
    away = wrist - joints[:, KNUCKLE]
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    # An arm may go on past the camera, and is seen as far as it lies before it.
    ahead = (wrist[:, 2] - radius) / np.maximum(-away[:, 2], 1e-6)
    ends = wrist + np.where(away[:, 2] < 0.0, np.clip(ahead, 0.0, length), length)[:, None] * away
    for t, (start, end) in enumerate(zip(wrist, ends, strict=True)):
        if start[2] <= radius:
            continue
        (x0, y0), (x1, y1) = ((K @ point)[:2] / point[2] for point in (start, end))
        along = ((x - x0) * (x1 - x0) + (y - y0) * (y1 - y0)) / max((x1 - x0) ** 2 + (y1 - y0) ** 2, 1e-6)
        along = along.clip(0.0, 1.0)
        reach = K[0, 0] * radius / (start[2] + along * (end[2] - start[2]))
        found[t] = np.hypot(x - x0 - along * (x1 - x0), y - y0 - along * (y1 - y0)) < reach
    return found


def _log_ratio(images: np.ndarray, near: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Logarithm [T, H, W] of how many times as frequent colours are where `near` than where `far`."""
    shares = []
    for chosen in (near, far):
        counts = color_counts(images[chosen] / np.float32(255.0), np.ones(chosen.sum()))
        shares.append(np.log(counts / max(counts.sum(), 1.0) + _NEVER))
    table = shares[0] - shares[1]
    return np.stack([smoothed(table[color_cells(image / np.float32(255.0))]) for image in images])

"""Whether hand and object touch in a frame, as far as its masks say."""

from __future__ import annotations

import numpy as np
import scipy.ndimage

from bigs.types import MASK_VALUES, Side


def masks_touch(labels: np.ndarray, side: Side, reach: int) -> bool:
    """Whether the hand and the object in a label image [H, W] come within `reach` pixels of each other."""
    hand, item = labels == MASK_VALUES[side], labels == MASK_VALUES["object"]
    # What touches lies within reach of both boxes, a small part of the image.
    region = []
    for axis in (1, 0):
        spans = [np.flatnonzero(mask.any(axis=axis)) for mask in (hand, item)]
        if not all(len(span) for span in spans):
            return False
        first = max(span[0] for span in spans) - reach
        region.append(slice(max(first, 0), max(min(span[-1] for span in spans) + reach + 1, 0)))
    hand, item = hand[tuple(region)], item[tuple(region)]
    if not (hand.any() and item.any()):
        return False
    # A square is a row for each of a column's pixels.
    row = np.ones((1, 2 * reach + 1), dtype=bool)
    near = scipy.ndimage.binary_dilation(scipy.ndimage.binary_dilation(hand, row), row.T)
    return bool((near & item).any())

"""Whether hand and object touch in a frame, as far as its masks say."""

from __future__ import annotations

import numpy as np
import scipy.ndimage

from bigs.types import MASK_VALUES, Side


def masks_touch(labels: np.ndarray, side: Side, reach: int) -> bool:
    """Whether the hand and the object in a label image [H, W] come within `reach` pixels of each other."""
    hand, item = labels == MASK_VALUES[side], labels == MASK_VALUES["object"]
    if not (hand.any() and item.any()):
        return False
    # A square is a row for each of a column's pixels.
    row = np.ones((1, 2 * reach + 1), dtype=bool)
    near = scipy.ndimage.binary_dilation(scipy.ndimage.binary_dilation(hand, row), row.T)
    return bool((near & item).any())

"""Frames in which a segmentation lost what it followed."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

# What no mask shows for longer may be hidden, or gone.
_LONGEST = 3


def without_gaps(masks: np.ndarray) -> np.ndarray:
    """Masks in which frames without one, up to three in a row, show what those before and after share.

    Tracks that a lost mask cuts leave the frames before and after it to drift apart. Between frames an object
    moves little, so most of what both masks show is the object. The few features of something else that lies
    there fit no track.

    Args:
        masks: [T, H, W] bool, one object's pixels.

    Returns:
        [T, H, W] bool; gaps at either end and longer ones stay.
    """
    gaps = short_gaps(np.any(masks, axis=(1, 2)))
    if not gaps:
        return masks
    filled = masks.copy()
    for before, after in gaps:
        filled[before + 1 : after] = masks[before] & masks[after]
    return filled


def short_gaps(shown: np.ndarray) -> list[tuple[int, int]]:
    """The frames before and after each run of up to three frames that are not `shown` [T] (bool)."""
    frames = np.flatnonzero(shown).tolist()
    return [(before, after) for before, after in pairwise(frames) if 1 < after - before <= _LONGEST + 1]

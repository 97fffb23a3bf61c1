"""Masks of hands that go on over the arm, as those of tools that follow a whole limb do.

No hand reaches there, and a hand that is fitted to its arm ends far too near and in a wrong pose. So such
masks are cut at the wrist, and what lies beyond may hide things as a sleeve does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import scipy.ndimage

from bigs.data.base import Clip
from bigs.threads import side_by_side
from bigs.types import MASK_VALUES, Side

# Every so many pixels tell.
_STEP = 4
# How far hands go on beyond their wrists and estimates of wrists err, metres.
_BEYOND = 0.07
# A mask of which a larger share lies further out shows some arm. If a tenth of the frames of either hand do,
# all of both are cut: what made them follows limbs.
_SHARE, _PERCENTILE = 0.1, 90.0
# Cut so far on the hand's side of its wrist, metres: of a wrong arm more harm comes than of a missing wrist.
_MARGIN = 0.02
# Estimates that differ from most of so many frames around them are wrong.
_AROUND = 5
# Index of the middle finger's first joint, from which a line through the wrist goes on along the arm.
KNUCKLE = 4


def without_arms(clip: Clip, joints: Mapping[Side, np.ndarray]) -> Clip:
    """The clip with hands' masks cut at the wrist, and a note of it, where they show arms.

    Args:
        clip: with masks.
        joints: of the hands as estimated, [T, J, 3] in each frame's camera.
    """
    if not clip.mask_paths:
        return clip
    cuts: dict[Side, np.ndarray] = {side: _wrist_lines(places, clip.K) for side, places in joints.items()}
    frames = range(len(clip))
    shares = np.array(side_by_side(lambda t: _arm_shares(clip.mask(t)[::_STEP, ::_STEP], cuts, t), frames))
    if not (np.nanpercentile(np.vstack([shares, np.zeros(len(cuts))]), _PERCENTILE, axis=0) > _SHARE).any():
        return clip
    clip = replace(clip, arms=cuts)
    shown = side_by_side(lambda t: np.bincount(clip.mask(t).ravel(), minlength=256), frames)
    areas = clip.mask_areas | {side: np.array(shown)[:, MASK_VALUES[side]] for side in cuts}
    note = "masks: those of hands go on over the arms; cut at the wrists"
    return replace(clip, mask_areas=areas, notes=(*clip.notes, note))


def _wrist_lines(joints: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Lines [T, 3] across wrists: pixel (x, y) lies a x + b y + c metres beyond where masks are cut."""
    steady = scipy.ndimage.median_filter(joints[:, [0, KNUCKLE]], (_AROUND, 1, 1), mode="nearest")
    pixels = steady @ K.T
    pixels = pixels[..., :2] / np.maximum(pixels[..., 2:], 1e-6)
    away = pixels[:, 0] - pixels[:, 1]
    away /= np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-6)
    slopes = away * steady[:, 0, 2:] / K[0, 0]
    return np.concatenate([slopes, _MARGIN - (slopes * pixels[:, 0]).sum(-1, keepdims=True)], axis=-1)


def _arm_shares(labels: np.ndarray, cuts: Mapping[Side, np.ndarray], t: int) -> list[float]:
    """What share of each hand's mask lies further beyond its wrist than a hand; not a number without one."""
    shares = []
    for side, lines in cuts.items():
        row, column = np.nonzero(labels == MASK_VALUES[side])
        a, b, c = lines[t]
        beyond = a * (_STEP * column + 0.5) + b * (_STEP * row + 0.5) + c > _BEYOND + _MARGIN
        shares.append(float(beyond.mean()) if len(beyond) else np.nan)
    return shares

"""Masks that call the right hand left and the left hand right: trackers exchange hands now and then."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bigs.data.base import Clip
from bigs.data.oddities.plausible import frames_in_words
from bigs.threads import side_by_side
from bigs.types import MASK_VALUES, SIDES, Side

# Masks are compared at this share of their size.
_STEP = 2
# What a frame with exchanged labels costs, in shares of joints that lie on their own masks: they are rare.
_RARE = 0.3
# Masks of frames further apart than this say nothing of each other.
_LONGEST_GAP = 5


def with_labels_sorted(clip: Clip, joints: Mapping[Side, np.ndarray]) -> Clip:
    """The clip with exchanged labels of its masks changed back, and a note of them.

    A label should lie where that hand's estimated joints are, and where it lay in the frame before; the most
    likely sequence is found by dynamic programming over the whole clip.

    Args:
        clip: with masks.
        joints: of both hands as estimated, [T, J, 3] in each frame's camera; with one hand nothing changes.
    """
    if len(joints) < 2 or not clip.mask_paths:
        return clip
    shown = side_by_side(lambda t: _hands(clip.mask(t)), range(len(clip)))
    agreement = np.array([_agreement(clip, masks, joints, t) for t, masks in enumerate(shown)])
    swapped = _most_likely(agreement, shown)
    if not swapped.any():
        return clip
    areas = dict(clip.mask_areas)
    for side, other in zip(SIDES, reversed(SIDES), strict=True):
        areas[side] = np.where(swapped, clip.mask_areas[other], clip.mask_areas[side])
    note = f"masks: right and left hand exchanged in {frames_in_words(swapped)}; changed back"
    return replace(
        clip,
        swapped=swapped,
        mask_areas=areas,
        notes=(*clip.notes, note),
    )


def _hands(labels: np.ndarray) -> np.ndarray:
    """Where a mask shows each hand, [2, H, W] bool, shrunk."""
    small = labels[::_STEP, ::_STEP]
    return np.stack([small == MASK_VALUES[side] for side in SIDES])


def _agreement(clip: Clip, masks: np.ndarray, joints: Mapping[Side, np.ndarray], t: int) -> float:
    """The share of joints on their own hand's mask, less that on the other's, in [-1, 1]."""
    height, width = masks.shape[1:]
    total = 0.0
    for hand, side in enumerate(SIDES):
        cam = joints[side][t]
        depth = np.maximum(cam[:, 2:], 1e-6)
        pixels = np.floor((cam[:, :2] / depth * clip.K[[0, 1], [0, 1]] + clip.K[:2, 2]) / _STEP)
        inside = (pixels >= 0).all(1) & (pixels < (width, height)).all(1)
        column, row = pixels[inside].astype(int).T
        on = masks[:, row, column].sum(1) / len(cam)
        total += 0.5 * float(on[hand] - on[1 - hand])
    return total


def _most_likely(agreement: np.ndarray, shown: list[np.ndarray]) -> np.ndarray:
    """The sequence of exchanges [T] (bool) that agrees best with the joints and from frame to frame."""
    frames = np.flatnonzero([masks.any() for masks in shown])
    swapped = np.zeros(len(shown), dtype=bool)
    if len(frames) == 0:
        return swapped
    # Costs of leaving and of exchanging a frame's labels, and how each of them was best reached.
    own = [np.array([-agreement[t], agreement[t] + _RARE]) for t in frames]
    cost, reached = own[0], []
    for before, t, here in zip(frames[:-1], frames[1:], own[1:], strict=True):
        stay = _overlap(shown[before], shown[t]) if t - before <= _LONGEST_GAP else 0.0
        ways = cost[:, None] + np.array([[-stay, stay], [stay, -stay]])
        reached.append(ways.argmin(0))
        cost = ways.min(0) + here
    state = int(cost.argmin())
    for t, came in zip(frames[:0:-1], reversed(reached), strict=True):
        swapped[t] = state
        state = int(came[state])
    swapped[frames[0]] = state
    return swapped


def _overlap(before: np.ndarray, after: np.ndarray) -> float:
    """How much more hands [2, H, W] overlap with themselves than with each other, in [-1, 1]."""
    same = (before & after).sum()
    other = (before & after[::-1]).sum()
    return float(same - other) / max(int(same + other), 1)

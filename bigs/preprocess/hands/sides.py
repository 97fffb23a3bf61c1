"""Which keypoints are the right hand's and which the left's: detectors swap sides and find one hand twice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bigs.preprocess.hands.keypoints import JOINTS, Keypoints
from bigs.types import MASK_VALUES, SIDES, Side

# Frames on each side whose median predicts where a hand should be.
_REACH = 5
# Hands this near to each other, as a share of their size, are one hand found twice.
_SAME = 0.15
_SAME_JOINTS = 6
# Swapping must explain a frame better by this much (in hand sizes), so that touching hands stay as they are.
_MARGIN = 0.15
# A keypoint this far from every mask, as a share of the hand's size, is an outlier.
_STRAY = 0.2


class Sorted(NamedTuple):
    """Keypoints on their sides, and what had to be done for it."""

    hands: dict[Side, Keypoints]
    swapped: np.ndarray  # [T] bool
    doubled: dict[Side, np.ndarray]  # [T] bool: dropped, because it was the other hand


def sort_sides(hands: Mapping[Side, Keypoints], masks: Sequence[np.ndarray] | None = None) -> Sorted:
    """Undo swaps and drop doubles, by where each hand is in the frames around and, if given, by the masks.

    Args:
        hands: keypoints of one or two hands.
        masks: T label images [H, W].
    """
    frames = len(next(iter(hands.values())).points)
    doubled = {side: np.zeros(frames, dtype=bool) for side in hands}
    swapped = np.zeros(frames, dtype=bool)
    if len(hands) < 2:
        return Sorted(dict(hands), swapped, doubled)
    points = np.stack([hands[side].points for side in SIDES], axis=1)  # [T, 2, 21, 2]
    trust = np.stack([hands[side].confidence for side in SIDES], axis=1)
    size = _hand_size(points, trust)
    votes = np.zeros((frames, 2, 2)) if masks is None else _mask_votes(points, trust, masks)
    for step in range(10):
        # cost[t, i, j]: how badly the keypoints listed for side i fit side j. Masks come first, because a
        # clip that is swapped throughout agrees with itself.
        cost = -votes
        if step:
            cost = cost + _distances(points, trust, _usual_places(points, trust)) / size
        gain = cost[:, 0, 0] + cost[:, 1, 1] - cost[:, 0, 1] - cost[:, 1, 0]
        flip = gain > _MARGIN
        if step and not flip.any():
            break
        points[flip], trust[flip], votes[flip] = points[flip, ::-1], trust[flip, ::-1], votes[flip, ::-1]
        swapped ^= flip
    both = trust[:, 0] * trust[:, 1]
    apart = _joint_distance(points[:, 0], points[:, 1], both)
    same = (apart < _SAME * size) & ((both > 0).sum(-1) >= _SAME_JOINTS)
    wrong = np.where(cost[:, 0, 0] > cost[:, 1, 1], 0, 1)
    for i, side in enumerate(SIDES):
        doubled[side] = same & (wrong == i)
        trust[doubled[side], i] = 0.0
    found = {side: Keypoints(points[:, i], trust[:, i]) for i, side in enumerate(SIDES)}
    return Sorted(found, swapped, doubled)


def drop_strays(hands: Mapping[Side, Keypoints], distances: Sequence[np.ndarray]) -> dict[Side, Keypoints]:
    """Distrust keypoints that lie far from every hand and object of the masks.

    Args:
        hands: keypoints of each side.
        distances: T images [H, W] of the distance to the nearest labelled pixel, pixels.
    """
    found = {}
    for side, hand in hands.items():
        reach = _STRAY * _hand_size(hand.points[:, None], hand.confidence[:, None])
        confidence = hand.confidence.copy()
        for t, distance in enumerate(distances):
            row, column = _cells(hand.points[t], distance.shape)
            if (distance < np.inf).any():
                confidence[t, distance[row, column] > reach] = 0.0
        found[side] = Keypoints(hand.points, confidence)
    return found


def _hand_size(points: np.ndarray, trust: np.ndarray) -> float:
    """The median extent of hands [T, S, 21, 2] in pixels."""
    pairs = zip(points.reshape(-1, JOINTS, 2), trust.reshape(-1, JOINTS) > 0, strict=True)
    sizes = [np.ptp(hand[seen], axis=0).max() for hand, seen in pairs if seen.sum() > 2]
    return max(float(np.median(sizes)) if sizes else 1.0, 1.0)


def _usual_places(points: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """The median of every joint over the other frames around [T, 2, 21, 2], NaN if there is none."""
    frames = len(points)
    seen = np.where(trust[..., None] > 0, points, np.nan)
    usual = np.full_like(points, np.nan)
    for t in range(frames):
        near = [s for s in range(max(0, t - _REACH), min(frames, t + _REACH + 1)) if s != t]
        known = np.isfinite(seen[near]).any(axis=0)
        usual[t][known] = np.nanmedian(np.where(known, seen[near], 0.0), axis=0)[known]
    return usual


def _distances(points: np.ndarray, trust: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """Mean distance [T, 2, 2] of the keypoints listed for side i to where side j is; 0 if unknown."""
    table = np.zeros((len(points), 2, 2))
    for i in (0, 1):
        for j in (0, 1):
            weight = trust[:, i] * np.isfinite(usual[:, j, :, 0])
            table[:, i, j] = _joint_distance(points[:, i], np.nan_to_num(usual[:, j]), weight)
    return table


def _joint_distance(first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> np.ndarray:
    apart = np.linalg.norm(first - second, axis=-1)
    return (weight * apart).sum(-1) / np.maximum(weight.sum(-1), 1e-9)


def _mask_votes(points: np.ndarray, trust: np.ndarray, masks: Sequence[np.ndarray]) -> np.ndarray:
    """Share [T, 2, 2] of the keypoints listed for side i that lie in the mask of side j."""
    votes = np.zeros((len(points), 2, 2))
    for t, mask in enumerate(masks):
        for i in (0, 1):
            row, column = _cells(points[t, i], mask.shape)
            labels = mask[row, column]
            for j, side in enumerate(SIDES):
                hits = trust[t, i] * (labels == MASK_VALUES[side])
                votes[t, i, j] = hits.sum() / max(trust[t, i].sum(), 1e-9)
    return votes


def _cells(points: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The pixels under points [..., 2]; the nearest one for those outside."""
    column, row = np.moveaxis(np.floor(points).astype(int), -1, 0)
    return np.clip(row, 0, shape[0] - 1), np.clip(column, 0, shape[1] - 1)

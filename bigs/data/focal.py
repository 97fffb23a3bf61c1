"""A clip seen through a longer or shorter lens: estimates keep their pictures and change their depths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bigs.data.base import Clip, HandTrack, ObjectTrack
from bigs.types import Side


def with_focal_factor(clip: Clip, rest_wrists: Mapping[Side, np.ndarray], factor: float) -> Clip:
    """The clip with both focal lengths and every subject's depth times `factor`.

    Args:
        clip: with estimates.
        rest_wrists: the rest wrist joint [3] of each hand's shape, metres.
        factor: positive.
    """
    K = clip.K.copy()
    K[[0, 1], [0, 1]] *= factor

    def away(points_world: np.ndarray) -> np.ndarray:
        rotation = clip.cam_from_world[:, :3, :3]
        depth = np.einsum("tj,tj->t", rotation[:, 2], points_world) + clip.cam_from_world[:, 2, 3]
        return (factor - 1.0) * depth[:, None] * rotation[:, 2]

    def hand(side: Side, track: HandTrack) -> HandTrack:
        return replace(track, transl=track.transl + away(rest_wrists[side] + track.transl))

    def obj(track: ObjectTrack) -> ObjectTrack:
        return replace(track, transl=track.transl + away(track.rotations @ track.middle() + track.transl))

    hands = {side: hand(side, track) for side, track in clip.hands.items()}
    return replace(clip, K=K, hands=hands, object=None if clip.object is None else obj(clip.object))

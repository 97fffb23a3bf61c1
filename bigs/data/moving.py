"""Tracks carried into another world. A hand turns about its wrist, so its rest wrist joint takes part."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.checks import check_shape
from bigs.data.base import HandTrack, ObjectTrack
from bigs.data.formats.annotation import Annotation, ObjectTruth
from bigs.types import Side

Rigid = TypeVar("Rigid", ObjectTrack, ObjectTruth)


def move_hand(track: HandTrack, new_from_old: np.ndarray, rest_wrist: np.ndarray) -> HandTrack:
    """A hand in another world: R' = A R and, since it turns about J0, t' = A (J0 + t) + b - J0.

    Args:
        track: the hand.
        new_from_old: rigid motions [T, 4, 4] with rotation A and translation b.
        rest_wrist: J0, the rest wrist joint of the track's shape, [3] metres, of that side's model.

    Raises:
        InputError: another shape.
    """
    check_shape("new_from_old", new_from_old, (len(track.transl), 4, 4))
    check_shape("rest_wrist", rest_wrist, (3,))
    rotation, translation = new_from_old[:, :3, :3], new_from_old[:, :3, 3]
    turned = rotation @ Rotation.from_rotvec(track.global_orient).as_matrix()
    wrists = np.einsum("tij,tj->ti", rotation, rest_wrist + track.transl) + translation
    return replace(track, global_orient=Rotation.from_matrix(turned).as_rotvec(), transl=wrists - rest_wrist)


def move_object(track: Rigid, new_from_old: np.ndarray) -> Rigid:
    """An object in another world, by rigid motions [T, 4, 4].

    Raises:
        InputError: another shape.
    """
    check_shape("new_from_old", new_from_old, (len(track.transl), 4, 4))
    rotation, translation = new_from_old[:, :3, :3], new_from_old[:, :3, 3]
    return replace(
        track,
        rotations=rotation @ track.rotations,
        transl=np.einsum("tij,tj->ti", rotation, track.transl) + translation,
    )


def in_world(
    annotation: Annotation, new_from_old: np.ndarray, rest_wrists: Mapping[Side, np.ndarray]
) -> Annotation:
    """An annotation in another world, seen by the same cameras.

    Args:
        annotation: what to carry over.
        new_from_old: a rigid motion [4, 4], or one for each frame [T, 4, 4].
        rest_wrists: the rest wrist joint [3] of each hand's shape, metres.

    Raises:
        InputError: another shape.
    """
    if new_from_old.shape != (4, 4):
        check_shape("new_from_old", new_from_old, (len(annotation), 4, 4))
    motions = np.broadcast_to(new_from_old, (len(annotation), 4, 4))
    return replace(
        annotation,
        cam_from_world=annotation.cam_from_world @ np.linalg.inv(motions),
        hands={
            side: move_hand(track, motions, rest_wrists[side]) for side, track in annotation.hands.items()
        },
        object=None if annotation.object is None else move_object(annotation.object, motions),
    )

"""Checks that a clip's estimates are plausible for two hands in front of a camera.

The impossible is refused in one sentence. Single faults are removed like missing estimates, and what is
merely odd is kept; both leave a note in the clip.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.checks import InputError
from bigs.data.base import Clip, HandTrack, ObjectTrack
from bigs.data.meshes import LONGEST_M, SHORTEST_M
from bigs.data.tracks import check_turns, fill_rotations, fill_vectors
from bigs.types import Entity, Side

# Projection is singular at the camera, and at 100 m a hand is a single pixel.
NEAREST_M, FARTHEST_M = 0.01, 100.0
# In standard deviations of MANO's shapes: no person has 10, and at 50 the model is no hand any more.
ODD_BETA, MOST_BETA = 10.0, 50.0
# A box has eight corners; fewer points give no shape, and fewer than a hundred only a rough one.
LEAST_POINTS, FEW_POINTS = 8, 100
# A point this many times further from the middle than nine in ten others is not on the object (1.9 in real
# clips).
STRAY = 10.0
# The object's extent in the image over the root of its mask's area: 1.5 to 3.4 in whole clips, more for thin
# or half hidden objects, less for what fills the image.
ODD_SIZE, WRONG_SIZE = (0.4, 6.0), (0.1, 15.0)
# A mask with fewer pixels says nothing about size.
_LEAST_AREA = 20
# The challenge's file has float16, and scales the scene so that the camera is at distance 2.
_HALF_MAX, _HALF_SPACE = 65504.0, 2.0


def plausible(clip: Clip, rest_wrists: Mapping[Side, np.ndarray]) -> Clip:
    """The clip with single faults taken out and noted.

    Frames in which a hand or the object is behind the camera, or absurdly far away, become invalid and are
    filled from their neighbours. Points that are far from all others are dropped.

    Args:
        clip: as its loader made it.
        rest_wrists: [3] metres, where the wrist is in each hand's rest pose in the clip's shape.

    Raises:
        InputError: a size, place, turn or shape that cannot be.
    """
    notes: list[str] = []
    hands = {
        side: _plausible_hand(clip, side, track, rest_wrists[side], notes)
        for side, track in clip.hands.items()
    }
    obj = None if clip.object is None else _plausible_object(clip, clip.object, notes)
    clip = replace(clip, hands=hands, object=obj, notes=(*clip.notes, *notes))
    _check_shift(clip)
    return clip


def _plausible_hand(
    clip: Clip, side: Side, track: HandTrack, rest_wrist: np.ndarray, notes: list[str]
) -> HandTrack:
    where = f"{clip.folder}: {side} hand"
    rotvecs = np.concatenate([track.global_orient[:, None], track.hand_pose], axis=1)
    check_turns(where, rotvecs, track.valid)
    beta = float(np.abs(track.betas).max())
    if beta > MOST_BETA:
        raise InputError(
            f"{where}: expected shape parameters between -{MOST_BETA:g} and {MOST_BETA:g}, found {beta:.3g}"
        )
    if beta > ODD_BETA:
        notes.append(
            f"{side} hand: a shape parameter is {beta:.3g} standard deviations; no real hand is like that"
        )
    faults = _misplaced(clip, side, rest_wrist + track.transl, track.valid, notes)
    if not faults.any():
        return track
    valid = track.valid & ~faults
    filled = fill_rotations(rotvecs, valid)
    track = HandTrack(filled[:, 0], filled[:, 1:], fill_vectors(track.transl, valid), track.betas, valid)
    _check_filled(clip, side, rest_wrist + track.transl)
    return track


def _plausible_object(clip: Clip, track: ObjectTrack, notes: list[str]) -> ObjectTrack:
    metric = track.points @ track.metric_from_canon[:3, :3].T + track.metric_from_canon[:3, 3]
    middle = np.median(metric, axis=0)
    distance = np.linalg.norm(metric - middle, axis=1)
    radius = float(np.percentile(distance, 90))
    if not SHORTEST_M < 2.0 * radius < LONGEST_M:
        raise InputError(
            f"{clip.folder}: object: expected points of {SHORTEST_M:g} to {LONGEST_M:g} m once scaled, "
            f"found {2.0 * radius:.3g} m (scale {track.scale:.3g})"
        )
    kept = distance <= STRAY * radius
    if not clip.annotated and kept.sum() < LEAST_POINTS:
        raise InputError(
            f"{clip.folder}: object: expected at least {LEAST_POINTS} points, found {int(kept.sum())}"
        )
    if not kept.all():
        notes.append(
            f"object: {int((~kept).sum())} of {len(kept)} points lie up to {distance.max():.3g} m from the "
            "others; they were left out"
        )
        colors = None if track.colors is None else track.colors[kept]
        track = replace(track, points=track.points[kept], colors=colors)
    if not clip.annotated and kept.sum() < FEW_POINTS:
        notes.append(f"object: only {int(kept.sum())} points; its shape will be little more than a guess")
    faults = _misplaced(clip, "object", track.rotations @ middle + track.transl, track.valid, notes)
    if faults.any():
        valid = track.valid & ~faults
        rotvecs = Rotation.from_matrix(track.rotations).as_rotvec()
        track = replace(
            track,
            rotations=Rotation.from_rotvec(fill_rotations(rotvecs[:, None], valid)[:, 0]).as_matrix(),
            transl=fill_vectors(track.transl, valid),
            valid=valid,
        )
        _check_filled(clip, "object", track.rotations @ middle + track.transl)
    _check_size(clip, _in_camera(clip, track.rotations @ middle + track.transl)[:, 2], radius, track, notes)
    return track


def _in_camera(clip: Clip, places: np.ndarray) -> np.ndarray:
    """Places in the clip's world [T, 3] as each frame's camera sees them."""
    to_cam = clip.cam_from_world
    return np.einsum("tij,tj->ti", to_cam[:, :3, :3], places) + to_cam[:, :3, 3]


def _misplaced(
    clip: Clip, entity: Entity, places: np.ndarray, valid: np.ndarray, notes: list[str]
) -> np.ndarray:
    """In which of the valid frames something is behind the camera or too far away, [T] bool."""
    if clip.annotated:  # measured poses are not repaired
        return np.zeros(len(valid), dtype=bool)
    seen = _in_camera(clip, places)
    behind = valid & (seen[:, 2] < NEAREST_M)
    away = valid & ~behind & (np.linalg.norm(seen, axis=1) > FARTHEST_M)
    name = entity if entity == "object" else f"{entity} hand"
    for wrong, found in ((behind, "behind the camera"), (away, f"more than {FARTHEST_M:g} m away")):
        if (behind | away)[valid].all() and wrong.any():
            raise InputError(
                f"{clip.folder}: {name}: expected {NEAREST_M:g} to {FARTHEST_M:g} m in front of the camera, "
                f"found it {found} in {frames_in_words(wrong)}"
            )
        if wrong.any():
            notes.append(
                f"{name}: {found} in {frames_in_words(wrong)}; taken as missing and filled from neighbours"
            )
    return behind | away


def _check_filled(clip: Clip, entity: Entity, places: np.ndarray) -> None:
    behind = _in_camera(clip, places)[:, 2] < NEAREST_M
    if behind.any():
        raise InputError(
            f"{clip.folder}: {entity}: expected interpolated poses in front of the camera, found "
            f"poses behind it in {frames_in_words(behind)}"
        )


def _check_size(clip: Clip, depths: np.ndarray, radius: float, track: ObjectTrack, notes: list[str]) -> None:
    """Compare how large the object's points are in the images with how large its masks are."""
    areas = clip.mask_areas["object"]
    told = track.valid & (areas >= _LEAST_AREA)
    if clip.annotated or not told.any():
        return
    extent = float(clip.K[0, 0]) * 2.0 * radius / depths[told]
    ratio = float(np.median(extent / np.sqrt(areas[told])))
    found = (
        f"they span {float(np.median(extent)):.3g} pixels where its mask has {int(np.median(areas[told]))}"
    )
    if not WRONG_SIZE[0] < ratio < WRONG_SIZE[1]:
        raise InputError(
            f"{clip.folder}: object: expected points as large as its masks, found that {found} "
            f"(scale {track.scale:.3g})"
        )
    if not ODD_SIZE[0] < ratio < ODD_SIZE[1]:
        notes.append(f"object: its points may be of the wrong size: {found} (scale {track.scale:.3g})")


def _check_shift(clip: Clip) -> None:
    """The challenge's file can hold the scene: it is made from every clip, after all the work."""
    length = float(np.linalg.norm(clip.normalize_shift))
    tracks = [track.transl for track in clip.hands.values()]
    if clip.object is not None:
        tracks.append(clip.object.transl)
    farthest = max(float(np.linalg.norm(_in_camera(clip, transl), axis=1).max()) for transl in tracks)
    if not 0.0 < length < FARTHEST_M or _HALF_SPACE / length * (farthest + LONGEST_M + length) > _HALF_MAX:
        raise InputError(
            f"{clip.folder}: normalize_shift: expected the camera's place relative to the scene, metres, "
            f"found {length:.3g} for a scene that reaches {farthest:.3g} m"
        )


def frames_in_words(flags: np.ndarray) -> str:
    """Some frames as text, the first of them by number."""
    numbers = np.flatnonzero(flags).tolist()
    if len(numbers) == 1:
        return f"frame {numbers[0]}"
    first = ", ".join(map(str, numbers[:5]))
    return f"{len(numbers)} frames ({first}{', ...' if len(numbers) > 5 else ''})"

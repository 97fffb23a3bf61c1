"""The paper's limited view: a quarter of a clip's frames, chosen so that they show little of the object."""

from __future__ import annotations

import numpy as np

from bigs.data.base import Clip

SHARE = 0.25


def object_directions(clip: Clip) -> np.ndarray:
    """From where the camera sees the object in each frame, in the object's own axes: unit vectors [T, 3].

    The clip must have an object.
    """
    track, to_cam = clip.object, clip.cam_from_world
    assert track is not None
    rotations = to_cam[:, :3, :3] @ track.rotations
    middles = track.points_world().mean(axis=1)
    centers = np.einsum("tij,tj->ti", to_cam[:, :3, :3], middles) + to_cam[:, :3, 3]
    towards = -np.einsum("tji,tj->ti", rotations, centers)
    return towards / np.linalg.norm(towards, axis=1, keepdims=True)


def limited_frames(directions: np.ndarray, share: float = SHARE) -> tuple[np.ndarray, float]:
    """The frames that see the object from the fewest sides.

    The paper samples a quarter of the frames "by not including the full viewpoints of the object" and gives
    no list. Here it is the frames whose viewing directions lie nearest to one of them, that one for which the
    furthest of them is nearest; ties go to the earlier frame.

    Args:
        directions: see `object_directions`, [T, 3].
        share: of the frames, rounded up.

    Returns:
        Indices of the frames in their order, and the radius in radians of the cap that their directions fill.
    """
    count = max(1, int(np.ceil(share * len(directions))))
    angles = np.arccos(np.clip(directions @ directions.T, -1.0, 1.0))
    nearest = np.argsort(angles, axis=1, kind="stable")[:, :count]
    reach = np.take_along_axis(angles, nearest[:, -1:], axis=1)[:, 0]
    middle = int(np.argmin(reach))
    return np.sort(nearest[middle]), float(reach[middle])

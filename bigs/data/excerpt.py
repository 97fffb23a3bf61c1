"""A clip, or a trajectory, of other frames than it has: fewer, or more by going to and fro."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bigs.data.base import Clip
from bigs.types import HandObjectTrajectory


def to_and_fro(available: int, count: int) -> np.ndarray:
    """`count` indices [count] into `available` frames, forwards and backwards in turn: motion has no jump."""
    there = np.arange(available)
    period = np.concatenate([there, there[-2:0:-1]])
    return np.resize(period, count)


def excerpt(clip: Clip, frames: np.ndarray) -> Clip:
    """The clip with the given frames only, in that order; one that comes again keeps its name.

    Args:
        clip: the clip.
        frames: [T'] indices of its frames.
    """
    hands = {
        side: replace(
            track,
            global_orient=track.global_orient[frames],
            hand_pose=track.hand_pose[frames],
            transl=track.transl[frames],
            valid=track.valid[frames],
        )
        for side, track in clip.hands.items()
    }
    obj = clip.object
    if obj is not None:
        obj = replace(
            obj, rotations=obj.rotations[frames], transl=obj.transl[frames], valid=obj.valid[frames]
        )
    return replace(
        clip,
        frame_names=tuple(clip.frame_names[t] for t in frames),
        image_paths=tuple(clip.image_paths[t] for t in frames),
        mask_paths=tuple(clip.mask_paths[t] for t in frames) if clip.mask_paths else (),
        cam_from_world=clip.cam_from_world[frames],
        hands=hands,
        object=obj,
        optics=None if clip.optics is None else clip.optics.chosen(frames),
        swapped=None if clip.swapped is None else clip.swapped[frames],
        arms=None if clip.arms is None else {side: lines[frames] for side, lines in clip.arms.items()},
        gains=None if clip.gains is None else clip.gains[frames],
        mask_areas={entity: areas[frames] for entity, areas in clip.mask_areas.items()},
    )


def excerpt_trajectory(
    trajectory: HandObjectTrajectory, frames: Sequence[int] | np.ndarray
) -> HandObjectTrajectory:
    """The trajectory of the given frames only, in that order.

    Args:
        trajectory: the trajectory.
        frames: [T'] indices of its frames.
    """
    verts = trajectory.object_verts
    return replace(
        trajectory,
        frame_names=tuple(trajectory.frame_names[t] for t in frames),
        joints={side: joints[frames] for side, joints in trajectory.joints.items()},
        verts={side: verts[frames] for side, verts in trajectory.verts.items()},
        object_verts=None if verts is None else verts[frames],
    )

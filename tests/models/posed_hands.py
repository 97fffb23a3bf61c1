"""A hand's Gaussians in given poses, without a scene."""

from __future__ import annotations

from torch import Tensor

from bigs.hand import HandModel
from bigs.models.canonical import CanonicalHand
from bigs.models.hand_splats import rest_points
from bigs.models.poses import HandFrames
from bigs.models.posing import hand_part, pose_parts
from bigs.types import Gaussians, Side


def pose_hand(
    model: HandModel, hand: CanonicalHand, betas: Tensor, frames: HandFrames, side: Side
) -> Gaussians:
    """Carry canonical Gaussians of the right hand to B frames, whose poses are the right hand's, too."""
    skeleton = model.skeleton(betas, frames.hand_pose, frames.global_orient, frames.wrist)
    points = rest_points(hand, betas, frames.hand_pose)
    return pose_parts([hand_part(hand, points, skeleton.bone_transforms, side)])

"""The 21 joints of a right hand alone, without its skin: what a fit to keypoints poses thousands of times.

Finger angles are counted about anatomical axes: bend towards the palm, spread across it, twist along the
bone. Their ranges are round numbers for a healthy adult hand, set by hand and fitted to no data set.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.hand import HandModel
from bigs.hand.lbs import forward_kinematics, pose_corrective, skin_points

# MANO's joint numbers of each finger.
FINGERS = {"index": (1, 2, 3), "middle": (4, 5, 6), "pinky": (7, 8, 9), "ring": (10, 11, 12)}
THUMB = (13, 14, 15)
# A MANO hand lies palm down.
_PALM = (0.0, -1.0, 0.0)


@dataclass(frozen=True)
class AngleRange:
    """What an angle usually is and how far it can go, radians."""

    mean: float
    spread: float  # standard deviation of a broad prior
    lowest: float
    highest: float


_FINGER_JOINTS = (
    (AngleRange(0.5, 0.6, -0.4, 1.6), AngleRange(0.0, 0.2, -0.4, 0.4), AngleRange(0.0, 0.1, -0.2, 0.2)),
    (AngleRange(0.6, 0.6, -0.1, 1.9), AngleRange(0.0, 0.05, -0.1, 0.1), AngleRange(0.0, 0.05, -0.1, 0.1)),
    (AngleRange(0.4, 0.4, -0.2, 1.4), AngleRange(0.0, 0.05, -0.1, 0.1), AngleRange(0.0, 0.05, -0.1, 0.1)),
)
# The thumb's saddle joint turns about two axes and, forced by its ligaments, a little about the third.
_THUMB_JOINTS = (
    (AngleRange(0.1, 0.3, -0.7, 0.9), AngleRange(0.0, 0.3, -0.7, 0.7), AngleRange(0.0, 0.25, -0.6, 0.6)),
    (AngleRange(0.3, 0.3, -0.3, 1.1), AngleRange(0.0, 0.1, -0.2, 0.2), AngleRange(0.0, 0.1, -0.2, 0.2)),
    (AngleRange(0.3, 0.4, -0.4, 1.5), AngleRange(0.0, 0.05, -0.1, 0.1), AngleRange(0.0, 0.05, -0.1, 0.1)),
)
# The last two joints of a finger share tendons: the outer one bends by about this share of the other.
_TENDON_SHARE, _TENDON_SPREAD = 0.6, 0.25


class HandPoses(NamedTuple):
    """Poses of a right hand in the camera frame; any leading axes."""

    angles: Tensor  # [..., 15, 3] anatomical: bend, spread, twist of each finger joint
    orient: Tensor  # [..., 3, 3]
    wrist: Tensor  # [..., 3] metres


class HandSkeleton:
    """Joints and fingertips of a right-hand model as functions of shape and pose."""

    def __init__(self, right: HandModel) -> None:
        tips = right.tip_vertex_ids
        self.parents = right.parents
        self.rest_joints = right.J_regressor @ right.v_template  # [16, 3]
        self.rest_tips = right.v_template[tips]  # [5, 3]
        # [10, 21, 3]
        moves = right.shapedirs.permute(2, 0, 1)
        self.shape_moves = torch.cat([right.J_regressor @ moves, moves[:, tips]], dim=1)
        self.tip_weights = right.lbs_weights[tips]
        self.tip_posedirs = right.posedirs[tips] if right.has_posedirs else None
        self.axes = _anatomical_axes(self.rest_joints)  # [15, 3, 3], rows bend, spread, twist
        rows = [_FINGER_JOINTS[i] for _ in range(4) for i in range(3)] + list(_THUMB_JOINTS)
        table = torch.tensor([[(a.mean, a.spread, a.lowest, a.highest) for a in row] for row in rows])
        self.mean, self.spread, self.lowest, self.highest = table.unbind(-1)  # [15, 3] each

    def size(self, betas: Tensor) -> Tensor:
        """From the wrist to the middle finger's knuckle, metres, of the shape `betas` [10]."""
        joints = self.rest_joints + torch.einsum("s,sjc->jc", betas, self.shape_moves)[:16]
        return (joints[4] - joints[0]).norm()

    def fingers(self, angles: Tensor) -> Tensor:
        """Rotation vectors [..., 15, 3] of anatomical angles [..., 15, 3] (bend, spread, twist)."""
        return torch.einsum("...ja,jac->...jc", angles, self.axes)

    def joints(self, betas: Tensor, angles: Tensor, orient: Tensor, wrist: Tensor) -> Tensor:
        """The 21 joints [B, 21, 3] in the order of `HandModel`, metres.

        Args:
            betas: [10], shared.
            angles: [B, 15, 3] anatomical.
            orient: [B, 3, 3].
            wrist: [B, 3] metres.
        """
        moved = torch.einsum("s,sjc->jc", betas, self.shape_moves)
        turns = axis_angle_to_matrix(self.fingers(angles))
        rotations = torch.cat([orient[:, None], turns], dim=1)
        joints, bones = forward_kinematics(rotations, self.rest_joints + moved[:16], self.parents, wrist)
        tips = self.rest_tips + moved[16:]
        if self.tip_posedirs is not None:
            tips = tips + pose_corrective(self.tip_posedirs, turns)
        return torch.cat([joints, skin_points(tips, self.tip_weights, bones)], dim=1)

    def unlikeliness(self, angles: Tensor) -> Tensor:
        """How unusual [B] finger angles [B, 15, 3] are: squared deviations, more beyond the limits."""
        usual = ((angles - self.mean) / self.spread).square().sum((-1, -2))
        beyond = (self.lowest - angles).clamp_min(0.0) + (angles - self.highest).clamp_min(0.0)
        middle, end = angles[:, 1:12:3, 0], angles[:, 2:12:3, 0]
        tendons = ((end - _TENDON_SHARE * middle) / _TENDON_SPREAD).square().sum(-1)
        # A tenth of a radian beyond a limit counts like four standard deviations.
        return usual + tendons + (beyond / 0.025).square().sum((-1, -2))


def _anatomical_axes(joints: Tensor) -> Tensor:
    """Unit axes [15, 3, 3] of every finger joint in the rest pose: bend, spread, twist."""
    palm = joints.new_tensor(_PALM)
    axes = joints.new_zeros(15, 3, 3)
    for root, middle, last in (*FINGERS.values(), THUMB):
        for joint, start, end in ((root, root, middle), (middle, middle, last), (last, middle, last)):
            along = torch.nn.functional.normalize(joints[end] - joints[start], dim=0)
            bend = torch.nn.functional.normalize(torch.linalg.cross(along, palm), dim=0)
            axes[joint - 1] = torch.stack([bend, torch.linalg.cross(along, bend), along])
    return axes

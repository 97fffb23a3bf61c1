"""Grasps: stretches of a clip over which a hand moves with the object it holds.

A hand that holds a rigid object keeps one pose in the object's frame. While the object turns, the frames of a
grasp are then so many views of one still hand, and what no single view shows, depth and bending towards the
camera, is seen from the side in another.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bigs.fused.hand_poses import Carried
from bigs.geometry.rotations import robust_mean_rotation
from bigs.hand import mirror_rotation
from bigs.models.poses import HandFrames, ObjectFrames


class Grasps(nn.Module):
    """The grasps of one hand; row g of every table is grasp g. There is room for one per frame.

    Rotations are those of the canonical hand, so for a left hand they are relative to the object as the
    mirror shows it; positions are in the object's own frame, metres at its initial size.
    """

    of_frame: Tensor
    certainty: Tensor
    slack: Tensor
    base_orient: Tensor
    base_pose: Tensor
    base_position: Tensor

    def __init__(self, n_frames: int, *, mirrored: bool) -> None:
        """No grasp yet. `mirrored` for a left hand."""
        super().__init__()
        self.mirrored = mirrored
        self.register_buffer("of_frame", torch.full((n_frames,), -1))
        # Certainty that a frame belongs to its grasp; 0 outside grasps.
        self.register_buffer("certainty", torch.zeros(n_frames))
        # Factor on the residuals that a frame of a grasp adds to it.
        self.register_buffer("slack", torch.zeros(()))
        self.register_buffer("base_orient", torch.eye(3).repeat(n_frames, 1, 1))
        self.register_buffer("base_pose", torch.eye(3).repeat(n_frames, 15, 1, 1))
        self.register_buffer("base_position", torch.zeros(n_frames, 3))
        self.orient = nn.Parameter(torch.zeros(n_frames, 3))
        self.pose = nn.Parameter(torch.zeros(n_frames, 15, 3))
        self.position = nn.Parameter(torch.zeros(n_frames, 3))

    @property
    def count(self) -> int:
        """The number of grasps."""
        return int(self.of_frame.max()) + 1

    def covers(self, frames: Tensor) -> Tensor:
        """Which of `frames` [B] belong to a grasp, [B] bool."""
        return self.of_frame[frames] >= 0

    def pose_residuals(self) -> Tensor:
        """Finger residuals [T, 15, 3] of every frame's grasp; zero where there is none."""
        grasped = self.of_frame >= 0
        return self.pose[self.of_frame.clamp_min(0)] * grasped[:, None, None]

    def forward(self, object_frames: ObjectFrames) -> Carried | None:
        """What carries the hand in the frames of `object_frames`; None if there are no grasps."""
        if not self.count:
            return None
        return Carried(
            self.base_orient,
            self.base_pose,
            self.base_position,
            self.orient,
            self.pose,
            self.position,
            *object_frames,
            self.of_frame,
            float(self.slack),
            self.mirrored,
        )

    def release(self, frames: list[int]) -> None:
        """Let go of the hand in some frames, at grasps' ends; it then has its own poses there."""
        self.of_frame[frames] = -1
        self.certainty[frames] = 0.0

    @torch.no_grad()
    def set(
        self,
        of_frame: Tensor,
        slack: float,
        hand: HandFrames,
        object_frames: ObjectFrames,
        certainty: Tensor | None = None,
    ) -> None:
        """Start grasps from all frames' poses of hand and object: a grasp takes the mean of its frames.

        Args:
            of_frame: [T] number of each frame's grasp, -1 for none.
            slack: factor on the residuals of frames in a grasp; 0 makes it rigid.
            hand: poses of the canonical hand in all T frames, the wrist in true camera space.
            object_frames: the object's poses in all T frames.
            certainty: [T] in [0, 1], how sure each frame's grasp is; 1 in all grasps if not given.
        """
        for parameter in self.parameters():
            parameter.zero_()
        self.of_frame.copy_(of_frame)
        self.slack.fill_(slack)
        self.certainty.copy_((of_frame >= 0).to(self.certainty) if certainty is None else certainty)
        seen = object_frames.rotations
        if self.mirrored:
            seen = mirror_rotation(seen)
        orient = seen.transpose(-1, -2) @ hand.global_orient
        away = (hand.wrist - object_frames.centers)[..., None]
        position = (object_frames.rotations.transpose(-1, -2) @ away)[..., 0] / object_frames.scale
        for g in range(self.count):
            own = self.of_frame == g
            self.base_orient[g] = robust_mean_rotation(orient[own])
            self.base_pose[g] = robust_mean_rotation(hand.hand_pose[own].transpose(0, 1))
            self.base_position[g] = position[own].median(0).values

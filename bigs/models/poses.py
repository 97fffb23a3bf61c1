"""Per-frame poses: fixed estimates plus trainable residuals, composed on SO(3).

Positions are a ray and a logarithmic depth: an image hardly shows depth, so the two need separate rates, and
a step in log depth is the same fraction near and far.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from bigs.fused.hand_poses import Carried, Learned, hand_poses
from bigs.geometry.rotations import axis_angle_to_matrix


class HandFrames(NamedTuple):
    """Poses of one hand at B frames, as poses of the canonical (right) hand."""

    global_orient: Tensor  # [B, 3, 3]
    hand_pose: Tensor  # [B, 15, 3, 3]
    wrist: Tensor  # [B, 3] metres


class ObjectFrames(NamedTuple):
    """Similarity poses of the object at B frames: x_cam = scale * R x + centre."""

    rotations: Tensor  # [B, 3, 3]
    centers: Tensor  # [B, 3] metres
    scale: Tensor  # [] one number for the clip


class RayPositions(nn.Module):
    """Positions in camera space as a point on the z = 1 plane and a logarithmic depth."""

    base_ray: Tensor
    base_log_depth: Tensor

    def __init__(self, positions: Tensor) -> None:
        """`positions` [T, 3], metres, z > 0: where the residuals start from."""
        super().__init__()
        frames = positions.shape[0]
        self.register_buffer("base_ray", positions[:, :2] / positions[:, 2:])
        self.register_buffer("base_log_depth", positions[:, 2].log())
        self.ray = nn.Parameter(torch.zeros(frames, 2))
        self.log_depth = nn.Parameter(torch.zeros(frames))

    def forward(self, frames: Tensor, ray_freedom: Tensor | None = None) -> Tensor:
        """Positions [B, 3] of `frames` [B].

        `ray_freedom` [B] is what residuals of rays are multiplied by, 1 if not given.
        """
        ray = self.ray[frames]
        if ray_freedom is not None:
            ray = ray_freedom[:, None] * ray
        depth = torch.exp(self.base_log_depth[frames] + self.log_depth[frames])
        return torch.cat([(self.base_ray[frames] + ray) * depth[:, None], depth[:, None]], dim=-1)

    @torch.no_grad()
    def restart(self, positions: Tensor, frames: Tensor | slice = slice(None)) -> None:
        """Take `positions` [B, 3] of some frames, or of all, for their start; their residuals become zero."""
        self.base_ray[frames] = positions[:, :2] / positions[:, 2:]
        self.base_log_depth[frames] = positions[:, 2].log()
        self.ray[frames] = 0.0
        self.log_depth[frames] = 0.0


class HandPoses(nn.Module):
    """One hand's poses over a clip; a left hand's rotations are stored mirrored."""

    base_orient: Tensor
    base_pose: Tensor
    estimated_pose: Tensor
    estimated_log_depth: Tensor
    expected_log_depth: Tensor
    has_expected_depth: Tensor

    def __init__(self, global_orient: Tensor, hand_pose: Tensor, wrist: Tensor) -> None:
        """Starts: rotations [T, 3, 3] and [T, 15, 3, 3], wrist joint positions [T, 3] in metres."""
        super().__init__()
        frames = global_orient.shape[0]
        self.register_buffer("base_orient", global_orient)
        self.register_buffer("base_pose", hand_pose)
        # The initial pose; `base_pose` changes during training.
        self.register_buffer("estimated_pose", hand_pose.clone())
        self.register_buffer("estimated_log_depth", wrist[:, 2].log())
        # Expected logarithmic depth of a frame, and which frames have one.
        self.register_buffer("expected_log_depth", torch.zeros(frames))
        self.register_buffer("has_expected_depth", torch.zeros(frames, dtype=torch.bool))
        self.orient = nn.Parameter(torch.zeros(frames, 3))
        self.pose = nn.Parameter(torch.zeros(frames, 15, 3))
        # Constant error of a per-frame regressor.
        self.pose_bias = nn.Parameter(torch.zeros(15, 3))
        self.position = RayPositions(wrist)

    def forward(self, frames: Tensor, carried: Carried | None = None) -> HandFrames:
        """The poses of `frames` [B] (integer indices).

        In frames of a grasp, if there are any, `carried` gives the poses that residuals start from instead of
        the module's own; see `bigs.fused.hand_poses`.
        """
        position = self.position
        learned = Learned(
            self.base_orient,
            self.base_pose,
            position.base_ray,
            position.base_log_depth,
            self.orient,
            self.pose,
            self.pose_bias,
            position.ray,
            position.log_depth,
        )
        return HandFrames(*hand_poses(frames, learned, carried))

    @torch.no_grad()
    def restart(self, poses: HandFrames) -> None:
        """Take `poses` of all T frames for the start; the residuals become zero."""
        self.pose_bias.zero_()
        self.restart_frames(torch.arange(len(self.orient)), poses)

    @torch.no_grad()
    def restart_frames(self, frames: Tensor, poses: HandFrames) -> None:
        """Take `poses` of some frames [B] for their start; of the residuals only the shared one stays."""
        self.base_orient[frames] = poses.global_orient
        self.base_pose[frames] = poses.hand_pose
        self.orient[frames] = 0.0
        self.pose[frames] = -self.pose_bias
        self.position.restart(poses.wrist, frames)


class PoseErrors(NamedTuple):
    """How far an object's start poses are off, one standard deviation, by frame."""

    turn: Tensor  # [T, 3, 3] square root of the rotations' covariance, radians, camera axes
    ray: Tensor  # [T] standard deviation of the position on the z = 1 plane


# Typical error of an unmeasured estimate, for which the learning rates were chosen.
USUAL_TURN = 0.025  # radians
USUAL_RAY = 0.006


class ObjectPoses(nn.Module):
    """The object's poses over a clip and its size.

    One logarithmic scale multiplies size *and* depth, so that changing it leaves the projection alone: that
    is the one quantity a single camera cannot see.

    Residuals of turn and ray count in usual errors of an estimate. Where the start is known better they are
    scaled down alike, so that one learning rate and one pose prior suit frames of all kinds.
    """

    base_orient: Tensor
    turn_freedom: Tensor
    ray_freedom: Tensor
    measured: Tensor

    def __init__(self, rotations: Tensor, centers: Tensor, errors: PoseErrors | None = None) -> None:
        """Starts: rotations [T, 3, 3] and positions [T, 3] (metres) of the canonical origin.

        `errors` tell how well they are known; without them all frames are as uncertain as usual.
        """
        super().__init__()
        frames = rotations.shape[0]
        self.register_buffer("base_orient", rotations)
        self.orient = nn.Parameter(torch.zeros(frames, 3))
        self.position = RayPositions(centers)
        self.log_scale = nn.Parameter(torch.zeros(()))
        turn, ray = torch.eye(3).repeat(frames, 1, 1), torch.ones(frames)
        if errors is not None:
            size = torch.linalg.matrix_norm(errors.turn, ord=2)[:, None, None]
            turn = errors.turn / size.clamp_min(USUAL_TURN)
            ray = (errors.ray / USUAL_RAY).clamp(max=1.0)
        # Factors on the residuals, at most 1.
        self.register_buffer("turn_freedom", turn)
        self.register_buffer("ray_freedom", ray)
        # Whether the start was measured, so that its pose prior counts rays, too.
        self.register_buffer("measured", torch.tensor(float(errors is not None)))

    def forward(self, frames: Tensor) -> ObjectFrames:
        """The poses of `frames` [B]."""
        scale = self.log_scale.exp()
        turn = (self.turn_freedom[frames] @ self.orient[frames][..., None])[..., 0]
        return ObjectFrames(
            axis_angle_to_matrix(turn) @ self.base_orient[frames],
            scale * self.position(frames, ray_freedom=self.ray_freedom[frames]),
            scale,
        )

    def departures(self) -> Tensor:
        """Residuals [T, 3] or, where the start was measured, [T, 5], in radians of a usual error."""
        if not self.measured:
            return self.orient
        return torch.cat([self.orient, USUAL_TURN / USUAL_RAY * self.position.ray], dim=1)

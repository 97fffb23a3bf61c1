"""A hand's poses from what was learned of frames and of grasps, all frames in one pass."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

import bigs._raster as _raster
from bigs.fused.arrays import array, array_or_none, shaped


class Learned(NamedTuple):
    """Where the poses of a clip's T frames start, which gets no gradient, and residuals in radians.

    A position is a point on the z = 1 plane and a logarithmic depth.
    """

    base_orient: Tensor  # [T, 3, 3]
    base_pose: Tensor  # [T, J, 3, 3]
    base_ray: Tensor  # [T, 2]
    base_log_depth: Tensor  # [T]
    orient: Tensor  # [T, 3] turns the hand in camera space
    pose: Tensor  # [T, J, 3] turns joints in their own frames
    pose_bias: Tensor  # [J, 3] added to every frame's
    ray: Tensor  # [T, 2]
    log_depth: Tensor  # [T]


class Carried(NamedTuple):
    """G grasps in the object's frame, whose starts get no gradient, and the object in B frames.

    A mirrored hand's rotations are relative to the object as the mirror of the plane x = 0 shows it.
    """

    base_orient: Tensor  # [G, 3, 3]
    base_pose: Tensor  # [G, J, 3, 3]
    base_position: Tensor  # [G, 3]
    orient: Tensor  # [G, 3]
    pose: Tensor  # [G, J, 3]
    position: Tensor  # [G, 3]
    rotations: Tensor  # [B, 3, 3]
    centers: Tensor  # [B, 3]
    scale: Tensor  # []
    of_frame: Tensor  # [T] long, each frame's grasp; negative for none
    slack: float  # what the residuals of a frame in a grasp are multiplied by
    mirrored: bool


# The tensors that take part in gradients or stand beside those that do.
_OWN = len(Learned._fields)
_GRASPS = len(Carried._fields) - 3


def hand_poses(frames: Tensor, learned: Learned, carried: Carried | None) -> tuple[Tensor, Tensor, Tensor]:
    """Rotations [B, 3, 3] and [B, J, 3, 3] and wrists [B, 3] of some frames.

    Outside grasps, exp(orient) R and P exp(pose + bias), and residuals of ray and depth are added. In a grasp
    the same residuals times the slack change what the grasp gives: seen(R_object) exp(orient) R,
    P exp(pose), and s R_object (position + residual) + centre.

    Args:
        frames: [B] long.
        learned: of the clip's frames.
        carried: None if no frame belongs to a grasp.
    """
    tensors = [*learned, *(() if carried is None else carried[:_GRASPS])]
    held = None if carried is None else (array(carried.of_frame), carried.slack, carried.mirrored)
    return _HandPoses.apply(frames.tolist(), held, *tensors)


class _HandPoses(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, frames: list[int], held: tuple[Any, float, bool] | None, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.save_for_backward(*tensors)
        ctx.frames, ctx.held = frames, held
        ctx.set_materialize_grads(False)
        posed = _raster.hand_poses_forward(*_called(tensors, frames, held))
        orient, pose, wrist = map(torch.from_numpy, posed)
        return orient.view(-1, 3, 3), pose.view(len(frames), -1, 3, 3), wrist.view(-1, 3)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulls: Tensor | None) -> tuple:
        tensors = ctx.saved_tensors
        given = [array_or_none(pull) for pull in pulls]
        arrays, frames, carried = _called(tensors, ctx.frames, ctx.held)
        own, grasps = _raster.hand_poses_backward(arrays, frames, carried, given)
        found = [None] * 4 + list(own)
        if grasps is not None:
            found += [None] * 3 + list(grasps)
        return (
            None,
            None,
            *(
                shaped(value, tensor) if value is not None and want else None
                for value, tensor, want in zip(found, tensors, ctx.needs_input_grad[2:], strict=True)
            ),
        )


def _called(tensors: tuple[Tensor, ...], frames: list[int], held: tuple[Any, float, bool] | None) -> tuple:
    arrays = tuple(map(array, tensors))
    return arrays[:_OWN], frames, None if held is None else (arrays[_OWN:], *held)

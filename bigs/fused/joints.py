"""Rotation vectors to matrices, and a joint tree from the rotations of its joints."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

import bigs._raster as _raster
from bigs.fused.arrays import array, array_or_none, shaped


def rotations(axis_angle: Tensor) -> Tensor:
    """Matrices [..., 3, 3] of rotation vectors [..., 3] (radians), by Rodrigues' formula."""
    return _Rotations.apply(axis_angle)


def pose_tree(
    rotations: Tensor, rest_joints: Tensor, parents: tuple[int, ...], root: Tensor
) -> tuple[Tensor, Tensor]:
    """Joints [T, K, 3] and transforms [T, K, 4, 4] from rest; see `bigs.hand.lbs.forward_kinematics`."""
    return _Tree.apply(parents, rotations, rest_joints, root)


class _Rotations(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, axis_angle: Tensor) -> Tensor:
        ctx.save_for_backward(axis_angle)
        matrices = torch.from_numpy(_raster.rotations_forward((array(axis_angle),)))
        return matrices.view(*axis_angle.shape, 3)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_matrices: Tensor) -> Tensor:
        (axis_angle,) = ctx.saved_tensors
        return shaped(_raster.rotations_backward((array(axis_angle), array(v_matrices))), axis_angle)


class _Tree(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, parents: tuple[int, ...], *tensors: Tensor) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(*tensors)
        # The root's entry counts for nothing, and the engine has no sign for it.
        ctx.parents = (0, *parents[1:])
        ctx.set_materialize_grads(False)
        joints, bones = map(torch.from_numpy, _raster.tree_forward(tuple(map(array, tensors)), ctx.parents))
        lead = tensors[0].shape[:2]
        return joints.view(*lead, 3), bones.view(*lead, 4, 4)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulls: Tensor | None) -> tuple:
        tensors = ctx.saved_tensors
        given = [array_or_none(pull) for pull in pulls]
        found = _raster.tree_backward(tuple(map(array, tensors)), ctx.parents, given)
        return (
            None,
            *(
                shaped(value, tensor) if want else None
                for value, tensor, want in zip(found, tensors, ctx.needs_input_grad[1:], strict=True)
            ),
        )

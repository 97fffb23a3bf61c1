"""What it costs when fingers turn and bend as those of hands hardly do."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

import bigs._raster as _raster
from bigs.fused.arrays import array, shaped


class FingerCosts(NamedTuple):
    """Means over poses, square radians for small angles; scalars."""

    # Of ||R_a - 2 R_b + R_c||_F^2 / 2 over the joints of three neighbouring fingers. Tendons, and the shape
    # of what a hand holds, bend fingers evenly from the index to the pinky, so a finger that nothing shows is
    # expected to be the mean of those beside it. The thumb has no such neighbours.
    unevenness: Tensor
    # Of the squared sines of turns that joints cannot make.
    impossible: Tensor
    # Of departures of the outermost joints from two thirds of the joints before them, the share of relaxed
    # fingers (Rijpkema and Girard, "Computer animation of knowledge-based human grasping", SIGGRAPH 1991).
    # Squares, but beyond 0.15 like the departures themselves (pseudo-Huber): what a finger presses on bends
    # its tip as it likes.
    uncoupled: Tensor


def finger_costs(hand_pose: Tensor, turns: Tensor, bends: Tensor) -> FingerCosts:
    """What a hand's finger joints cost; zeros of no poses.

    Args:
        hand_pose: rotations [B, 15, 3, 3] in MANO's joint order.
        turns: [M, 15, 3, 3], see `hand.impossible_turns`; no gradient.
        bends: [2, 2, 4, 15, 3, 3], see `hand.bends`; no gradient.

    Raises:
        ValueError: a shape that does not fit.
    """
    return FingerCosts(*_FingerCosts.apply(hand_pose, turns, bends))


class _FingerCosts(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, hand_pose: Tensor, *known: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(hand_pose, *known)
        found = _raster.finger_costs_forward((array(hand_pose), *map(array, known)))
        return tuple(torch.from_numpy(cost).view(()) for cost in found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulls: Tensor) -> tuple:
        tensors = ctx.saved_tensors
        found = _raster.finger_costs_backward(tuple(map(array, tensors)), [float(pull) for pull in pulls])
        return shaped(found, tensors[0]), None, None

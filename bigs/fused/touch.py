"""How far hands are from an object that moves, which a grid of signed distances in its own frame tells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

import bigs._raster as _raster
from bigs.fused.arrays import array, array_or_none, shaped
from bigs.fused.posing import Posing


class Group(NamedTuple):
    """Vertices of which those that reach furthest count: the whole hand, or a finger."""

    deepest: int  # how many of a frame's least distances are averaged, all of them if there are fewer
    vertices: tuple[int, ...] | None = None  # rising; None for all


class Touch(NamedTuple):
    """What touches in B frames."""

    depths: Tensor  # [B, G] mean of the least signed distances of each group, in the points' unit
    sunk: Tensor  # [B] sum over vertices of max(-d - tolerance, 0)^2 for signed distances d


def distances(points: Tensor, values: Tensor, bounds: Tensor) -> Tensor:
    """Signed distances [...] of points [..., 3], negative inside; no gradient.

    Trilinear samples of the grid; beyond it, the distance to its box is added.

    Args:
        points: [..., 3] in the object's frame.
        values: [Z, Y, X] distances.
        bounds: [2, 3] places of the first and the last value.
    """
    return torch.from_numpy(_raster.distances(tuple(map(array, (points, values, bounds))))).view(
        points.shape[:-1]
    )


def touch(
    hand: Posing,
    rotations: Tensor,
    centers: Tensor,
    scale: Tensor,
    values: Tensor,
    bounds: Tensor,
    groups: Sequence[Group],
    tolerance: float,
) -> Touch:
    """What of a hand touches an object; vertices that count for no number cost no gradient.

    Args:
        hand: V vertices in B frames; only points, weights, bones and `mirrored` count, weights without
            gradient.
        rotations, centers, scale: [B, 3, 3], [B, 3] and []; the object's point p is at scale R p + centre.
        values, bounds: as in `distances`, at scale 1; no gradient.
        groups: of its vertices, at most 32.
        tolerance: depth that does not count as sunk.
    """
    tensors = (hand.points, hand.weights, hand.bones, rotations, centers, scale, values, bounds)
    return Touch(*_Touch.apply((hand.mirrored, tuple(groups), tolerance), *tensors))


class _Touch(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, options: tuple[bool, tuple[Group, ...], float], *tensors: Tensor
    ) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(*tensors)
        ctx.options = options
        ctx.set_materialize_grads(False)
        depths, sunk, ctx.state = _raster.touch_forward(tuple(map(array, tensors)), options)
        return torch.from_numpy(depths).view(len(sunk), -1), torch.from_numpy(sunk)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulls: Tensor | None) -> tuple:
        tensors = ctx.saved_tensors
        points, bones, rotations, centers, scale = _raster.touch_backward(
            ctx.state, tuple(map(array, tensors)), ctx.options, [array_or_none(pull) for pull in pulls]
        )
        found = (points, None, bones, rotations, centers, scale, None, None)
        return (
            None,
            *(
                shaped(value, tensor) if value is not None and want else None
                for value, tensor, want in zip(found, tensors, ctx.needs_input_grad[1:], strict=True)
            ),
        )

"""Signed distances of points from an object that moves, read from a grid in the object's own frame."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

import bigs._raster as _raster
from bigs.fused.arrays import array, shaped


def moving_distances(
    points: Tensor, rotations: Tensor, centers: Tensor, scale: Tensor, values: Tensor, bounds: Tensor
) -> Tensor:
    """Distances [B, V] of points in camera space; negative inside.

    Trilinear samples of the grid times the scale; beyond the grid, the distance to its box is added.

    Args:
        points: [B, V, 3] metres.
        rotations, centers, scale: [B, 3, 3], [B, 3] and []; the object's point p is at scale R p + centre.
        values: [Z, Y, X] metres at scale 1; no gradient.
        bounds: [2, 3] places of the first and the last value in the object's frame; no gradient.
    """
    return _Distances.apply(points, rotations, centers, scale, values, bounds)


class _Distances(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, *others: Tensor) -> Tensor:
        ctx.save_for_backward(points, *others)
        distances, ctx.state = _raster.distances_forward(tuple(map(array, (points, *others))))
        return torch.from_numpy(distances).view(points.shape[:-1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_distances: Tensor) -> tuple:
        tensors = ctx.saved_tensors
        found = _raster.distances_backward(ctx.state, tuple(map(array, tensors)), array(v_distances))
        return (
            *(
                shaped(value, tensor) if want else None
                for value, tensor, want in zip(found, tensors[:4], ctx.needs_input_grad[:4], strict=True)
            ),
            None,
            None,
        )

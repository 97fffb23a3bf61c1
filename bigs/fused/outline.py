"""What a posed mesh covers of a picture, with the gradient that its outline has."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

import bigs._raster as _raster
from bigs.fused.arrays import array, shaped


def covered_shares(points: Tensor, faces: Tensor, K: Tensor, width: int, height: int) -> Tensor:
    """The share [B, H, W] of each pixel that a mesh covers, counted at 32 places of the pixel.

    Its gradient is that of the area itself: where what is covered ends at an edge, a shift of the edge by d
    along its outward normal adds d times its length. Triangles that reach behind the camera are not seen.

    Args:
        points: [B, V, 3] in camera space.
        faces: [F, 3] long; how they wind does not matter.
        K: [3, 3] intrinsics of the picture, without gradient.
        width, height: of the picture.

    Raises:
        ValueError: a point is not finite, or there is no vertex of an index.
    """
    return _Outline.apply(points, faces, K, (width, height))


class _Outline(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, faces: Tensor, K: Tensor, size: tuple[int, int]) -> Tensor:
        ctx.save_for_backward(points, faces, K)
        ctx.size = size
        shares, ctx.state = _raster.outline_forward((array(points), array(K)), (array(faces), size))
        return torch.from_numpy(shares).view(len(points), size[1], size[0])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, pull: Tensor) -> tuple:
        points, faces, K = ctx.saved_tensors
        found = _raster.outline_backward(
            ctx.state, (array(points), array(K)), (array(faces), ctx.size), array(pull)
        )
        return shaped(found, points), None, None, None

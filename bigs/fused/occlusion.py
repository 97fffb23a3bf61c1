"""How much of the sky above points other surfaces cover."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

import bigs._raster as _raster
from bigs.fused.arrays import array


class Discs(NamedTuple):
    """A surface in B frames as M small discs."""

    points: Tensor  # [B, M, 3] metres
    normals: Tensor  # [B, M, 3] unit, outwards
    areas: Tensor  # [M] square metres


def form_factors(points: Tensor, normals: Tensor, discs: Discs) -> Tensor:
    """The share of a point's light that each disc takes if nothing else is in the way, summed over discs.

    Light counts by the cosine at which it comes, and discs only where they face the point. The factor of a
    disc is A cos cos' / (pi d^2 + A), that of a distant disc made finite near by. Without gradient.

    Args:
        points: [B, N, 3] metres.
        normals: [B, N, 3] unit, outwards.
        discs: in the same frames, of the same dtype.

    Returns:
        Sums [B, N]; above 1 where one disc hides another.

    Raises:
        ValueError: shapes or dtypes do not fit.
    """
    arrays = tuple(map(array, (points, normals, *discs)))
    return torch.from_numpy(_raster.form_factors(arrays)).view(points.shape[:-1])

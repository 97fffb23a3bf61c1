"""A signed distance field on a grid."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from bigs.fused import touch as fused
from bigs.fused.posing import Posing
from bigs.fused.touch import Group, Touch
from bigs.geometry.surface import DistanceGrid

# Of a whole hand so many vertices count: a fingertip's or two.
WHOLE_HAND = Group(30)


class DistanceField(nn.Module):
    """Trilinear samples of a `DistanceGrid`; beyond the grid, the distance to its box is added."""

    values: Tensor  # [Z, Y, X] metres
    bounds: Tensor  # [2, 3] metres

    def __init__(self, grid: DistanceGrid) -> None:
        super().__init__()
        values = torch.as_tensor(grid.values, dtype=torch.float32)
        lower = torch.as_tensor(grid.origin, dtype=torch.float32)
        upper = lower + grid.spacing * (torch.tensor(values.shape) - 1)
        # x runs fastest.
        self.register_buffer("values", values.permute(2, 1, 0).contiguous(), persistent=False)
        self.register_buffer("bounds", torch.stack([lower, upper]), persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        """Signed distances [...] in metres of points [..., 3]; negative inside. Without gradient."""
        return fused.distances(points, self.values, self.bounds)

    def touch(
        self,
        hand: Posing,
        rotations: Tensor,
        centers: Tensor,
        scale: Tensor,
        groups: Sequence[Group] = (WHOLE_HAND,),
        tolerance: float = 0.001,
    ) -> Touch:
        """What of a hand touches the object in B poses; see `bigs.fused.touch.touch`."""
        return fused.touch(hand, rotations, centers, scale, self.values, self.bounds, groups, tolerance)

"""A signed distance field on a grid, sampled with gradients."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bigs.fused.distance import moving_distances
from bigs.geometry.surface import DistanceGrid


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
        """Signed distances [...] in metres of points [..., 3]; negative inside."""
        still, nowhere = torch.eye(3).to(points)[None], points.new_zeros(1, 3)
        flat = points.reshape(1, -1, 3)
        return self.of_moving(flat, still, nowhere, points.new_ones(())).reshape(points.shape[:-1])

    def of_moving(self, points: Tensor, rotations: Tensor, centers: Tensor, scale: Tensor) -> Tensor:
        """Signed distances [B, V] of points [B, V, 3] from the object in B poses, in the points' unit.

        The object's point p is at scale [] times rotation [B, 3, 3] times p, plus centre [B, 3].
        """
        return moving_distances(points, rotations, centers, scale, self.values, self.bounds)

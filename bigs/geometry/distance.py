"""A signed distance field on a grid, sampled with gradients."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bigs.geometry.surface import DistanceGrid


class DistanceField(nn.Module):
    """Trilinear samples of a `DistanceGrid`; beyond the grid, the distance to its box is added."""

    values: Tensor  # [1, 1, Z, Y, X] metres
    bounds: Tensor  # [2, 3] metres

    def __init__(self, grid: DistanceGrid) -> None:
        super().__init__()
        values = torch.as_tensor(grid.values, dtype=torch.float32)
        lower = torch.as_tensor(grid.origin, dtype=torch.float32)
        upper = lower + grid.spacing * (torch.tensor(values.shape) - 1)
        # grid_sample's last coordinate runs fastest, so the volume is stored [1, 1, Z, Y, X].
        self.register_buffer("values", values.permute(2, 1, 0)[None, None].contiguous(), persistent=False)
        self.register_buffer("bounds", torch.stack([lower, upper]), persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        """Signed distances [...] in metres of points [..., 3]; negative inside."""
        lower, upper = self.bounds
        inside = torch.maximum(torch.minimum(points, upper), lower)
        unit = (inside - lower) / (upper - lower) * 2.0 - 1.0
        sampled = torch.nn.functional.grid_sample(
            self.values, unit.reshape(1, 1, 1, -1, 3), mode="bilinear", align_corners=True
        ).reshape(points.shape[:-1])
        # A small constant under the root keeps the gradient finite for points inside the box.
        beyond = ((points - inside).square().sum(-1) + 1e-12).sqrt()
        return sampled + beyond

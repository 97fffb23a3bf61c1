"""A triplane: three axis-aligned feature planes sampled bilinearly at 3-D points (paper section 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class TriplaneConfig:
    """Size of a triplane; the paper's networks use 256 x 256 texels of 32 features."""

    features: int = 32
    resolution: int = 256
    # Standard deviation of the random start. The released code takes 1; a smaller one keeps the first images
    # close to the initial colours, which matters with hundreds of steps instead of thousands.
    init_std: float = 0.1


def sample_triplane(planes: Tensor, xyz: Tensor, bounds: Tensor) -> Tensor:
    """Features of points, the three planes' samples concatenated.

    Args:
        planes: [3, F, R, R] features on the xy, xz and yz planes.
        xyz: [N, 3] points; outside `bounds` the border's features are taken.
        bounds: [2, 3] lower and upper corner of the box that the planes cover, in the units of `xyz`.

    Returns:
        [N, 3F].
    """
    lower, upper = bounds
    unit = (xyz - lower) / (upper - lower) * 2.0 - 1.0
    pairs = torch.stack([unit[:, [0, 1]], unit[:, [0, 2]], unit[:, [1, 2]]])  # [3, N, 2]
    sampled = torch.nn.functional.grid_sample(
        planes, pairs[:, :, None], mode="bilinear", padding_mode="border", align_corners=True
    )  # [3, F, N, 1]
    return sampled[..., 0].permute(2, 0, 1).reshape(xyz.shape[0], -1)


class Triplane(nn.Module):
    """Stores the planes and their bounds and calls `sample_triplane`.

    The box is stretched over the subject, so that a hand of 20 cm uses all texels. (The released code
    queries metres in a box of +-1, where a hand touches 25 of 256 texels an axis.)
    """

    bounds: Tensor  # [2, 3] in the units of the points

    def __init__(self, config: TriplaneConfig, bounds: Tensor) -> None:
        super().__init__()
        self.planes = nn.Parameter(
            config.init_std * torch.randn(3, config.features, config.resolution, config.resolution)
        )
        self.register_buffer("bounds", bounds.clone())

    @property
    def out_features(self) -> int:
        """Length 3F of a point's features."""
        return 3 * self.planes.shape[1]

    def forward(self, xyz: Tensor) -> Tensor:
        """Features [N, 3F] of points [N, 3]."""
        return sample_triplane(self.planes, xyz, self.bounds)

"""Light that stands still while hands and object turn in it.

A Gaussian with one fixed colour cannot be lit from above in one frame and from below in the next. Here its
colour is an albedo times a smooth function of the direction its surface faces in camera space, one function
for the clip. (The paper has fixed colours; a run may switch this off.)
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bigs.types import Gaussians


class Lighting(nn.Module):
    """exp of a quadratic polynomial of the normal, per colour channel; 1 everywhere at the start.

    Irradiance under distant light is very nearly quadratic in the normal; the exponential keeps it positive.
    The constant is left out, since the albedo holds it.
    """

    def __init__(self) -> None:
        super().__init__()
        self.coefficients = nn.Parameter(torch.zeros(8, 3))

    def forward(self, gaussians: Gaussians) -> Gaussians:
        """Lit Gaussians: colours [B, N, 3] for albedos [N, 3] and camera-space quats [B, N, 4]."""
        return light(gaussians, self.coefficients)


def light(gaussians: Gaussians, coefficients: Tensor) -> Gaussians:
    """Multiply albedos by the light that falls on each Gaussian's third axis, its outward normal."""
    shade = torch.exp(quadratic_basis(third_axis(gaussians.quats)) @ coefficients)
    return gaussians._replace(colors=gaussians.colors * shade)


def third_axis(quats: Tensor) -> Tensor:
    """The direction [..., 3] to which quaternions [..., 4] (w x y z, any length) turn the z axis."""
    w, x, y, z = quats.unbind(-1)
    axis = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z], dim=-1)
    return axis / quats.square().sum(-1, keepdim=True).clamp_min(1e-12)


def quadratic_basis(normals: Tensor) -> Tensor:
    """The linear and quadratic harmonics [..., 8] of unit vectors [..., 3]."""
    x, y, z = normals.unbind(-1)
    return torch.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], dim=-1)

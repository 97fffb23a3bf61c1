"""Light that stands still while hands and object turn in it, and shade that changes.

A Gaussian with one fixed colour cannot be lit from above in one frame and from below in the next. Here its
colour is an albedo times a smooth function of the direction its surface faces in camera space: one quadratic
function for the clip, and for each subject and frame a linear one, since a hand that closes over the object
shades itself; for each part of a subject (a hand's bones, an object's regions) a constant as well, since a
finger shades its neighbour and a hand the side that it holds. (The paper has fixed colours; a run may switch
this off.)
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from bigs.types import Entity, Gaussians

# A hand has 16 bones, and an object gets as many regions.
N_PARTS = 16


class Lighting(nn.Module):
    """exp of a polynomial of the normal; 1 everywhere at the start.

    Irradiance under distant light is very nearly quadratic in the normal; the exponential keeps it positive.
    The clip's function has no constant, since the albedo holds it.
    """

    def __init__(self, entities: Iterable[Entity], n_frames: int) -> None:
        super().__init__()
        self.clip = nn.Parameter(torch.zeros(8, 3))
        # Constant, slopes along x, y, z, and parts. Brightness only: shade has no colour.
        self.shade = nn.ParameterDict(
            {entity: nn.Parameter(torch.zeros(n_frames, 4 + N_PARTS)) for entity in entities}
        )

    def forward(
        self,
        entity: Entity,
        gaussians: Gaussians,
        frames: Tensor,
        weights: Tensor,
        normals: Tensor | None = None,
    ) -> Gaussians:
        """Lit Gaussians of one entity at `frames` [B]; see `light`."""
        return light(gaussians, self.clip, self.shade[entity][frames], weights, normals)


def light(
    gaussians: Gaussians,
    clip: Tensor,
    shade: Tensor,
    weights: Tensor | None = None,
    normals: Tensor | None = None,
) -> Gaussians:
    """Multiply albedos [N, 3] by the light on each Gaussian's third axis, its outward normal in camera space.

    Args:
        gaussians: quats [B, N, 4].
        clip: [8, 3] coefficients of `quadratic_basis` for the whole clip.
        shade: [B, 4 + J] a constant, a slope, and a constant for each of J parts, for each frame.
        weights: [N, J] how far a Gaussian belongs to each part; None where there are none.
        normals: [B, N, 3] those third axes, where they are known already.

    Returns:
        The Gaussians with colours [B, N, 3].
    """
    normals = third_axis(gaussians.quats) if normals is None else normals
    shaded = shade[:, None, :1] + normals @ shade[:, 1:4, None]
    if weights is not None:
        shaded = shaded + weights @ shade[:, 4:, None]
    return gaussians._replace(colors=gaussians.colors * torch.exp(quadratic_basis(normals) @ clip + shaded))


def third_axis(quats: Tensor) -> Tensor:
    """The direction [..., 3] to which quaternions [..., 4] (w x y z, any length) turn the z axis."""
    w, x, y, z = quats.unbind(-1)
    axis = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z], dim=-1)
    return axis / quats.square().sum(-1, keepdim=True).clamp_min(1e-12)


def quadratic_basis(normals: Tensor) -> Tensor:
    """The linear and quadratic harmonics [..., 8] of unit vectors [..., 3]."""
    x, y, z = normals.unbind(-1)
    return torch.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], dim=-1)

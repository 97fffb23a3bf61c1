"""The object's Gaussians on their own: what a field said, in finer parts with parameters of their own.

A triplane of 128 texels shows no print on a label, and evaluating it for every finer Gaussian in every step
would cost ten times the rendering. Once it has given shape and rough colours it is evaluated a last time.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bigs.checks import InputError
from bigs.geometry.rotations import quat_to_matrix
from bigs.models.object_splats import CanonicalObject

# Neighbours at a distance of one over this many standard deviations cover a surface evenly.
_SIGMA_PER_SPACING = 0.6
_LEAST_OPACITY, _MOST_OPACITY = 1e-4, 1.0 - 1e-4


class ObjectDetail(nn.Module):
    """A canonical object without a field; takes the place of `ObjectSplats` in a scene."""

    def __init__(self, count: int) -> None:
        """Room for `count` Gaussians; see `split_object`."""
        super().__init__()
        self.register_buffer("base_means", torch.zeros(count, 3))
        self.register_buffer("base_quats", torch.zeros(count, 4))
        self.register_buffer("base_log_scales", torch.zeros(count, 3))
        self.register_buffer("opacity_logits", torch.zeros(count))
        self.register_buffer("color_logits", torch.zeros(count, 3))
        self.register_buffer("normals", torch.zeros(count, 3))
        # Along the normal, metres: along the surface others are there already.
        self.shift = nn.Parameter(torch.zeros(count))
        self.size = nn.Parameter(torch.zeros(count, 3))  # logarithmic
        self.opacity = nn.Parameter(torch.zeros(count))  # logit
        self.color = nn.Parameter(torch.zeros(count, 3))  # logit

    def forward(self) -> CanonicalObject:
        offsets = self.shift[:, None] * self.normals
        return CanonicalObject(
            self.base_means + offsets,
            offsets,
            self.base_quats,
            (self.base_log_scales + self.size).exp(),
            torch.sigmoid(self.opacity_logits + self.opacity),
            torch.sigmoid(self.color_logits + self.color),
            self.normals,
        )


@torch.no_grad()
def split_object(whole: CanonicalObject, parts: int, least_opacity: float) -> ObjectDetail:
    """Every Gaussian as `parts` x `parts` smaller ones in the plane of its first two axes.

    They stand where the parts of its share of the surface lie, and are as much smaller.

    Args:
        whole: the object.
        parts: along each of the two axes; 1 only prunes.
        least_opacity: Gaussians that are less opaque than this are left out.

    Raises:
        InputError: none is as opaque as that.
    """
    kept = whole.opacities >= least_opacity
    if not kept.any():
        most = float(whole.opacities.max())
        raise InputError(f"least_opacity: expected {most:.3f}, the largest, or less, found {least_opacity}")
    means, quats, scales = whole.means[kept], whole.quats[kept], whole.scales[kept]
    axes = quat_to_matrix(quats)[..., :2] * (scales[:, None, :2] / _SIGMA_PER_SPACING)  # [M, 3, 2]
    steps = (torch.arange(parts) + 0.5) / parts - 0.5
    grid = torch.cartesian_prod(steps, steps).reshape(-1, 2)  # [P, 2]
    count = len(means) * len(grid)

    def each(values: Tensor) -> Tensor:
        return values[:, None].expand(-1, len(grid), *values.shape[1:]).reshape(count, *values.shape[1:])

    detail = ObjectDetail(count)
    detail.base_means.copy_((means[:, None] + torch.einsum("mij,pj->mpi", axes, grid)).reshape(count, 3))
    detail.base_quats.copy_(each(quats))
    smaller = torch.tensor([1.0 / parts, 1.0 / parts, 1.0])
    detail.base_log_scales.copy_(each(scales * smaller).log())
    detail.opacity_logits.copy_(torch.logit(each(whole.opacities[kept]).clamp(_LEAST_OPACITY, _MOST_OPACITY)))
    detail.color_logits.copy_(torch.logit(each(whole.colors[kept]).clamp(1e-3, 1.0 - 1e-3)))
    detail.normals.copy_(each(whole.normals[kept]))
    return detail

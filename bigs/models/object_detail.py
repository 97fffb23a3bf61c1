"""The object's Gaussians without a field, split into finer parts."""

from __future__ import annotations

import torch
from torch import Tensor

from bigs.checks import InputError
from bigs.geometry.rotations import quat_to_matrix
from bigs.models.canonical import CanonicalObject
from bigs.models.free_gaussians import FreeGaussians
from bigs.models.lighting import N_PARTS

# Neighbours this many standard deviations apart cover a surface evenly.
_SIGMA_PER_SPACING = 0.6


class ObjectDetail(FreeGaussians):
    """A canonical object without a field; replaces `ObjectSplats` in a scene."""

    weights: Tensor

    def __init__(self, count: int) -> None:
        """Room for `count` Gaussians; see `split_object`."""
        super().__init__(count)
        self.register_buffer("weights", torch.zeros(count, N_PARTS))

    def forward(self) -> CanonicalObject:
        """The Gaussians as their parameters are now."""
        offsets = self.offsets
        return CanonicalObject(
            self.base_points + offsets,
            offsets,
            self.base_quats,
            self.scales,
            self.opacities,
            self.colors,
            self.normals,
            self.weights,
        )


@torch.no_grad()
def split_object(
    whole: CanonicalObject,
    parts: int | Tensor,
    least_opacity: float,
    freedom: Tensor | None = None,
    overlap: float = 1.0,
) -> ObjectDetail:
    """Every Gaussian as `parts` x `parts` smaller ones in the plane of its first two axes.

    They stand where the parts of its share of the surface lie, and are as much smaller, times `overlap`.

    Args:
        whole: the object, N Gaussians.
        parts: along each of the two axes, for all or for each [N]; 1 only prunes.
        least_opacity: Gaussians that are less opaque than this are left out.
        freedom: [N] in [0, 1], the factor on what the parts of each learn from now on; 1 if not given.
        overlap: how many times as wide as that the parts are; what stays whole stays as it is.

    Raises:
        InputError: none is as opaque as that.
    """
    kept = whole.opacities >= least_opacity
    if not kept.any():
        most = float(whole.opacities.max())
        raise InputError(f"least_opacity: expected {most:.3f}, the largest, or less, found {least_opacity}")
    along = torch.as_tensor(parts).expand(len(kept))[kept]  # [M]
    each = along.square()
    index = torch.nonzero(kept).flatten().repeat_interleave(each)  # [P] what each part is a part of
    along = along.repeat_interleave(each)
    rank = torch.arange(len(index)) - (each.cumsum(0) - each).repeat_interleave(each)
    place = (torch.stack([rank // along, rank % along], dim=-1) + 0.5) / along[:, None] - 0.5  # [P, 2]
    quats, scales = whole.quats[index], whole.scales[index]
    axes = quat_to_matrix(quats)[..., :2] * (scales[:, None, :2] / _SIGMA_PER_SPACING)  # [P, 3, 2]
    width = torch.where(along > 1, overlap / along, 1.0)
    smaller = torch.stack([width, width, torch.ones(len(index))], dim=-1)

    detail = ObjectDetail(len(index))
    detail.start(
        whole.means[index] + (axes @ place[..., None])[..., 0],
        quats,
        scales * smaller,
        whole.opacities[index],
        whole.colors[index],
        whole.normals[index],
    )
    detail.weights.copy_(whole.weights[index])
    if freedom is not None:
        detail.freedom.copy_(freedom[index])
    return detail


def replace_gaussians(detail: ObjectDetail, kept: Tensor, added: CanonicalObject) -> ObjectDetail:
    """The Gaussians marked in `kept` [N] (bool), to the last bit, and after them those of `added`."""
    count = len(added.means)
    more = (split_object(added, 1, 0.0) if count else ObjectDetail(0)).state_dict()
    joined = ObjectDetail(int(kept.sum()) + count)
    joined.load_state_dict(
        {name: torch.cat([values[kept], more[name]]) for name, values in detail.state_dict().items()}
    )
    return joined

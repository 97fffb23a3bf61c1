"""The canonical hand's Gaussians on their own, without a field behind them."""

from __future__ import annotations

import torch
from torch import Tensor

from bigs.geometry.rotations import quat_to_matrix
from bigs.hand import HandModel
from bigs.models.canonical import CanonicalHand
from bigs.models.free_gaussians import FreeGaussians
from bigs.models.hand_splats import HandSplats


class HandDetail(FreeGaussians):
    """A canonical right hand without a field; replaces `HandSplats` in a scene.

    How its Gaussians follow the shape and the bones is settled.
    """

    shapedirs: Tensor
    posedirs: Tensor | None
    base_weights: Tensor
    # Five times as large. What explains the edge of a sleeve would become a ray below it, where no picture
    # forbids anything.
    most_growth = 1.6

    def __init__(self, model: HandModel, splats: CanonicalHand) -> None:
        """`model` is the right hand; `splats` says how many Gaussians, and how they follow shape and pose."""
        super().__init__(len(splats.points))
        self.model = model
        self.register_buffer("shapedirs", splats.shapedirs.detach().clone(), persistent=False)
        posedirs = None if splats.posedirs is None else splats.posedirs.detach().clone()
        self.register_buffer("posedirs", posedirs, persistent=False)
        self.register_buffer("base_weights", splats.weights.detach().clone())

    def forward(self) -> CanonicalHand:
        """The Gaussians as their parameters are now."""
        return CanonicalHand(
            self.base_points + self.offsets,
            self.shapedirs,
            self.posedirs,
            self.base_weights,
            self.base_quats,
            self.scales,
            self.opacities,
            self.colors,
        )


@torch.no_grad()
def free_hand(hand: HandSplats | HandDetail, freedom: Tensor | None = None) -> HandDetail:
    """The Gaussians as they are now, without a field.

    `freedom` [N] in [0, 1] is the factor on what each of them learns from now on; 1 if not given.
    """
    whole = hand()
    detail = HandDetail(hand.model, whole)
    # A Gaussian is thin along its third axis, the surface's outward normal.
    normals = quat_to_matrix(whole.quats)[..., 2]
    detail.start(whole.points, whole.quats, whole.scales, whole.opacities, whole.colors, normals)
    if freedom is not None:
        detail.freedom.copy_(freedom)
    return detail

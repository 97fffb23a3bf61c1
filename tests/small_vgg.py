"""Random networks in VGG-16's layout with few channels, and the files in which others keep them."""

from __future__ import annotations

import torch
from torch import Tensor

from bigs.losses.perceptual import VggWeights

# Channels per convolution, and where torchvision's `features` has them.
WIDTHS = (4, 4, 6, 6, 8, 8, 8, 8, 8, 8, 8, 8, 8)
LAYERS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)


def torchvision_state(seed: int = 0) -> dict[str, Tensor]:
    """As `vgg16().state_dict()`: the features' convolutions and, ignored, a classifier."""
    generator = torch.Generator().manual_seed(seed)
    state, before = {}, 3
    for layer, width in zip(LAYERS, WIDTHS, strict=True):
        spread = (2.0 / (9 * before)) ** 0.5
        state[f"features.{layer}.weight"] = spread * torch.randn(width, before, 3, 3, generator=generator)
        state[f"features.{layer}.bias"] = 0.1 * torch.randn(width, generator=generator)
        before = width
    state["classifier.0.weight"] = torch.zeros(2, 2)
    return state


def lpips_channels(seed: int = 1) -> dict[str, Tensor]:
    """As the lpips package keeps its five linear layers."""
    generator = torch.Generator().manual_seed(seed)
    return {
        f"lin{block}.model.1.weight": torch.rand(1, WIDTHS[end - 1], 1, 1, generator=generator)
        for block, end in enumerate((2, 4, 7, 10, 13))
    }


def small_network(seed: int = 0) -> VggWeights:
    """What `load_perceptual_weights` makes of `torchvision_state`."""
    state = torchvision_state(seed)
    return VggWeights(
        tuple((state[f"features.{layer}.weight"], state[f"features.{layer}.bias"]) for layer in LAYERS)
    )

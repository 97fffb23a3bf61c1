"""Reading VGG-16, and LPIPS's channel weights, from the files that others publish."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from bigs.checks import InputError
from bigs.losses.perceptual import BLOCK_ENDS, VggWeights
from bigs.weights import checked_weight, load_weights

# Indices of the convolutions in torchvision's `features`.
_LAYERS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
# Key prefixes: torchvision's whole network, its features alone, and the slices of the lpips package.
_CONVOLUTION = re.compile(r"^(?:(?:.*\.)?(?:features|slice[1-5])\.)?(\d+)\.(weight|bias)$")
_CHANNELS = re.compile(r"^lin(\d)\.model\.1\.weight$")


def load_perceptual_weights(paths: Sequence[Path]) -> VggWeights:
    """VGG-16 from one file, or from several that together have what is needed; no code in them is run.

    Args:
        paths: torchvision's state dict (.pth or .safetensors), and LPIPS's channel weights, if they are in a
            file of their own.

    Raises:
        InputError: a file is missing or unreadable, or a layer is missing or of another shape.
    """
    found: dict[str, tuple[Tensor, Path]] = {}
    for path in paths:
        for key, value in load_weights(path, "VGG-16").items():
            convolution, channels = _CONVOLUTION.match(key), _CHANNELS.match(key)
            if convolution:
                found[f"features.{convolution[1]}.{convolution[2]}"] = value, path
            elif channels:
                found[f"lin{channels[1]}.model.1.weight"] = value, path
    where = " and ".join(map(str, paths))
    convolutions: list[tuple[Tensor, Tensor]] = []
    width = 3  # colours
    for layer in _LAYERS:
        name = f"features.{layer}"
        kernel = _take(found, f"{name}.weight", (None, width, 3, 3), where)
        width = len(kernel)
        convolutions.append((kernel, _take(found, f"{name}.bias", (width,), where)))
    if not any(key.startswith("lin") for key in found):
        return VggWeights(tuple(convolutions))
    channel_weights = []
    for block, end in enumerate(BLOCK_ENDS):
        width = len(convolutions[end - 1][0])
        channel_weights.append(
            _take(found, f"lin{block}.model.1.weight", (1, width, 1, 1), where).reshape(width)
        )
    return VggWeights(tuple(convolutions), tuple(channel_weights))


def _take(
    found: dict[str, tuple[Tensor, Path]], name: str, shape: tuple[int | None, ...], where: str
) -> Tensor:
    if name not in found:
        raise InputError(f"{where}: expected VGG-16 as torchvision names it, found no {name}")
    value, path = found[name]
    return checked_weight(f"{path}: {name}", value, shape)

"""PiDiNet, a small edge detector, from the files that its authors publish.

Su et al., "Pixel difference networks for efficient edge detection" (2021). Its convolutions take differences
of neighbouring pixels. A difference is linear, so each is an ordinary convolution with another kernel; the
kernels are turned into those once, when the file is read.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import conv2d, interpolate, max_pool2d

from bigs.checks import InputError
from bigs.weights import checked_weight, load_weights

# Blocks per scale; with the first convolution these are 16 layers.
_BLOCKS = (3, 4, 4, 4)
# Kinds of kernels, repeated over the layers: central, angular, radial, ordinary.
_KINDS = ("central", "angular", "radial", "ordinary")
# For each place of a 3 x 3 kernel, row by row, the place that is subtracted.
_AROUND = (3, 0, 1, 6, 4, 2, 7, 8, 5)
# Where a radial kernel's weights, except the first, go in 5 x 5: on the outer ring, negated on the inner one.
_OUTER = (0, 2, 4, 10, 14, 20, 22, 24)
_INNER = (6, 7, 8, 11, 13, 16, 17, 18)
# Dilations of the context module's four convolutions.
_DILATIONS = (5, 7, 9, 11)


@dataclass(frozen=True)
class PiDiNet:
    """The network; called with pictures it returns their edges."""

    weights: dict[str, Tensor]  # by their published names; difference kernels are ordinary ones here

    @torch.no_grad()
    def __call__(self, images: Tensor) -> Tensor:
        """Edges [B, 1, H, W] in [0, 1] of pictures [B, 3, H, W] in [0, 1], RGB.

        The network is given blue, green, red in [0, 1], unnormalised, as were the edges that the published
        soft-edge ControlNet was trained with.
        """
        height, width = images.shape[-2:]
        weights = {name: value.to(images) for name, value in self.weights.items()}
        x = _convolved(images.flip(1), weights, "init_block")
        maps = []
        for scale, blocks in enumerate(_BLOCKS):
            for block in range(1, blocks + 1):
                x = _block(x, weights, f"block{scale + 1}_{block}", halve=scale > 0 and block == 1)
            edges = _convolved(_context(x, weights, scale), weights, f"conv_reduces.{scale}.conv")
            maps.append(interpolate(edges, (height, width), mode="bilinear", align_corners=False))
        return _convolved(torch.cat(maps, 1), weights, "classifier").sigmoid()


def load_pidinet(path: Path) -> PiDiNet:
    """The network in a file: of any width, with or without its context and attention modules.

    Both kinds of published files are read: those of difference kernels, in the arrangement "carv4", and those
    already turned into ordinary ones.

    Raises:
        InputError: the file is missing or unreadable, or a layer is missing or of another shape.
    """
    found = {name.removeprefix("module."): value for name, value in load_weights(path, "PiDiNet").items()}
    layers = _Layers(path, found)
    width = channels = layers.take_kernel("init_block.weight", 0, None, 3)
    layer = 1
    for scale, blocks in enumerate(_BLOCKS):
        out = width * min(2**scale, 4)
        for block in range(1, blocks + 1):
            name = f"block{scale + 1}_{block}"
            layers.take_kernel(f"{name}.conv1.weight", layer, channels, 1)
            layers.take(f"{name}.conv2.weight", out, channels, 1, 1)
            if scale > 0 and block == 1:
                layers.take(f"{name}.shortcut.weight", out, channels, 1, 1)
                layers.take(f"{name}.shortcut.bias", out)
            channels = out
            layer += 1
        layers.take_head(scale, channels)
    layers.take("classifier.weight", 1, len(_BLOCKS), 1, 1)
    layers.take("classifier.bias", 1)
    return PiDiNet(layers.weights)


class _Layers:
    """The layers of a file, checked one by one as the network is walked through."""

    def __init__(self, path: Path, found: dict[str, Tensor]) -> None:
        self._path, self._found = path, found
        # Only the radial kernels reveal the kind of file.
        self._converted = found.get("block1_2.conv1.weight", torch.empty(0)).shape[-1:] == (5,)
        self.weights: dict[str, Tensor] = {}

    def take(self, name: str, *shape: int | None) -> int:
        """Keep a tensor; returns its first axis, which is the number of channels that a layer makes."""
        if name not in self._found:
            raise InputError(f"{self._path}: expected PiDiNet as its authors name it, found no {name}")
        self.weights[name] = checked_weight(f"{self._path}: {name}", self._found[name], shape)
        return len(self.weights[name])

    def take_kernel(self, name: str, layer: int, *shape: int | None) -> int:
        """Likewise, for the kernel [*shape, k, k] of one of the 16 layers that may take differences."""
        kind = _KINDS[layer % len(_KINDS)]
        side = 5 if self._converted and kind == "radial" else 3
        made = self.take(name, *shape, side, side)
        if not self._converted:
            self.weights[name] = ordinary_kernel(self.weights[name], kind)
        return made

    def take_head(self, scale: int, channels: int) -> None:
        """Keep what makes edges of the features of one scale."""
        context, attention = f"dilations.{scale}", f"attentions.{scale}"
        if any(name.startswith(f"{context}.") for name in self._found):
            channels = self._take_biased(f"{context}.conv1", channels)
            for index in range(len(_DILATIONS)):
                self.take(f"{context}.conv2_{index + 1}.weight", channels, channels, 3, 3)
        if any(name.startswith(f"{attention}.") for name in self._found):
            inner = self._take_biased(f"{attention}.conv1", channels)
            self.take(f"{attention}.conv2.weight", 1, inner, 3, 3)
        self.take(f"conv_reduces.{scale}.conv.weight", 1, channels, 1, 1)
        self.take(f"conv_reduces.{scale}.conv.bias", 1)

    def _take_biased(self, name: str, channels: int) -> int:
        made = self.take(f"{name}.weight", None, channels, 1, 1)
        self.take(f"{name}.bias", made)
        return made


def ordinary_kernel(kernel: Tensor, kind: str) -> Tensor:
    """The kernel [O, I, k, k] that sums the differences which `kernel` [O, I, 3, 3] weighs.

    - central: each neighbour minus the centre;
    - angular: each neighbour minus the next one clockwise;
    - radial: each pixel two steps out minus the one a step out in the same direction, so that k is 5; the
      first weight is not used;
    - ordinary: no differences.
    """
    flat = kernel.flatten(2)
    if kind == "central":
        flat = flat.clone()
        flat[..., 4] -= kernel.sum((2, 3))
    elif kind == "angular":
        flat = flat - flat[..., list(_AROUND)]
    elif kind == "radial":
        weights = flat[..., 1:]
        flat = flat.new_zeros(*flat.shape[:2], 25)
        flat[..., list(_OUTER)] = weights
        flat[..., list(_INNER)] = -weights
    side = 5 if kind == "radial" else 3
    return flat.unflatten(2, (side, side))


def _convolved(
    x: Tensor, weights: dict[str, Tensor], name: str, dilation: int = 1, groups: int = 1
) -> Tensor:
    """A layer that keeps the size of its input."""
    kernel = weights[f"{name}.weight"]
    padding = dilation * (kernel.shape[-1] // 2)
    bias = weights.get(f"{name}.bias")
    return conv2d(x, kernel, bias, padding=padding, dilation=dilation, groups=groups)


def _block(x: Tensor, weights: dict[str, Tensor], name: str, halve: bool) -> Tensor:
    if halve:
        x = max_pool2d(x, 2)
    differences = _convolved(x, weights, f"{name}.conv1", groups=x.shape[1]).relu()
    passed = _convolved(x, weights, f"{name}.shortcut") if halve else x
    return _convolved(differences, weights, f"{name}.conv2") + passed


def _context(x: Tensor, weights: dict[str, Tensor], scale: int) -> Tensor:
    """Features of one scale, with surroundings gathered and background held down if the file can."""
    name = f"dilations.{scale}"
    if f"{name}.conv1.weight" in weights:
        x = _convolved(x.relu(), weights, f"{name}.conv1")
        x = torch.stack(
            [_convolved(x, weights, f"{name}.conv2_{i + 1}", dilation=d) for i, d in enumerate(_DILATIONS)]
        ).sum(0)
    name = f"attentions.{scale}"
    if f"{name}.conv1.weight" in weights:
        share = _convolved(_convolved(x.relu(), weights, f"{name}.conv1"), weights, f"{name}.conv2")
        x = x * share.sigmoid()
    return x

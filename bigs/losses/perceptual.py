"""How different two images look to VGG-16 (the paper's L_vgg, Eq. 5); with LPIPS's channel weights, LPIPS.

Simonyan and Zisserman, "Very deep convolutional networks for large-scale image recognition" (2015); Zhang et
al., "The unreasonable effectiveness of deep features as a perceptual metric" (2018).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

# Image statistics of the network's training data, for values in [0, 1].
_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)
# Number of convolutions at the end of each block, where features are compared and the image is halved.
BLOCK_ENDS = (2, 4, 7, 10, 13)
# After four halvings, images of this size still have a pixel.
_LEAST_SIZE = 16


@dataclass(frozen=True)
class VggWeights:
    """The convolutions of VGG-16, from image to features; never trained here."""

    convolutions: tuple[tuple[Tensor, Tensor], ...]  # 13 kernels [C_out, C_in, 3, 3] with biases [C_out]
    channel_weights: tuple[Tensor, ...] | None = None  # LPIPS's, [C] for each of the five blocks

    def tensors(self) -> tuple[Tensor, ...]:
        """All weights, in a fixed order; for a digest."""
        pairs = [values for pair in self.convolutions for values in pair]
        return (*pairs, *(self.channel_weights or ()))


def vgg_features(images: Tensor, weights: VggWeights) -> list[Tensor]:
    """Features after each of the five blocks, [N, C, H / 2^k, W / 2^k], of images [N, 3, H, W] in [0, 1]."""
    mean, std = (torch.tensor(values, dtype=images.dtype)[:, None, None] for values in (_MEAN, _STD))
    x = (images - mean) / std
    features = []
    for done, (kernel, bias) in enumerate(weights.convolutions):
        if done in BLOCK_ENDS:
            x = torch.nn.functional.max_pool2d(x, 2)
        x = torch.nn.functional.conv2d(x, kernel, bias, padding=1).relu()
        if done + 1 in BLOCK_ENDS:
            features.append(x)
    return features


def perceptual_distance(pred: Tensor, target: Tensor, weights: VggWeights) -> Tensor:
    """Squared distance of unit feature vectors, a mean over pixels and images, summed over the five blocks.

    Channels count by `weights.channel_weights`, which makes this LPIPS, or else alike. No gradient reaches
    `target`.

    Args:
        pred, target: [N, 3, H, W] in [0, 1]; smaller ones than 16 x 16 are padded with black.
        weights: of the network.
    """
    height, width = pred.shape[-2:]
    pad = (0, max(0, _LEAST_SIZE - width), 0, max(0, _LEAST_SIZE - height))
    pred, target = (torch.nn.functional.pad(images, pad) for images in (pred, target))
    with torch.no_grad():
        expected = vgg_features(target, weights)
    total = pred.new_zeros(())
    for block, (a, b) in enumerate(zip(vgg_features(pred, weights), expected, strict=True)):
        difference = (_unit(a) - _unit(b)).square()
        if weights.channel_weights is not None:
            difference = difference * weights.channel_weights[block][:, None, None]
        total = total + difference.sum(1).mean()
    return total


def _unit(features: Tensor) -> Tensor:
    # The small number lies below the root, where a pixel without any feature would have no gradient.
    return features * (features.square().sum(1, keepdim=True) + 1e-10).rsqrt()


def masked_perceptual(
    pred: Tensor,
    target: Tensor,
    mask: Tensor,
    weights: VggWeights,
    generator: torch.Generator,
    *,
    patches: int = 4,
    size: int = 128,
) -> Tensor:
    """`perceptual_distance` of a few patches, both images over the same noise outside the mask.

    On noise, as in the released code, the network sees no border that both images share.

    Args:
        pred, target: [B, H, W, 3] in [0, 1].
        mask: [B, H, W] in [0, 1].
        weights: of the network.
        generator: decides patches and noise.
        patches: how many, over all B images.
        size: of a patch, pixels; smaller images are taken whole.
    """
    pairs = []
    for index, row, column in draw_patches(mask, patches, size, generator):
        place = (index, slice(row, row + size), slice(column, column + size))
        share = mask[place][..., None]
        noise = torch.rand(*share.shape[:2], 3, generator=generator, dtype=share.dtype)
        pairs.append(torch.stack([share * image[place] + (1.0 - share) * noise for image in (pred, target)]))
    both = torch.stack(pairs, dim=1).permute(0, 1, 4, 2, 3)
    return perceptual_distance(both[0], both[1], weights)


def draw_patches(
    mask: Tensor, count: int, size: int, generator: torch.Generator, on_mask: float = 0.9
) -> list[tuple[int, int, int]]:
    """Image, first row and first column of `count` patches of `size` pixels within masks [B, H, W].

    Centres lie on the mask with probability `on_mask`, anywhere else; images take turns.
    """
    images, height, width = mask.shape

    def draw(n: int) -> int:
        return int(torch.randint(n, (), generator=generator))

    first = draw(images)
    places = []
    for patch in range(count):
        index = (first + patch) % images
        inside = torch.nonzero(mask[index] > 0.5)
        aimed = float(torch.rand((), generator=generator)) < on_mask
        row, column = (
            inside[draw(len(inside))].tolist() if aimed and len(inside) else (draw(height), draw(width))
        )
        places.append(
            (
                index,
                min(max(row - size // 2, 0), max(height - size, 0)),
                min(max(column - size // 2, 0), max(width - size, 0)),
            )
        )
    return places

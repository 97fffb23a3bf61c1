"""Soft edges of pictures without a network, for a ControlNet without a PiDiNet file."""

from __future__ import annotations

from kornia.filters import gaussian_blur2d, spatial_gradient
from torch import Tensor

# Standard deviation of the blur before differences: one pixel at 512, where the published soft-edge networks
# work, and never less, since differences of neighbours cannot follow steeper slopes.
_BLUR = 1.0 / 512.0
_LEAST_BLUR = 1.0
# Slope, in intensity per blur, that gives 0.5: the steepest of a step of 0.1.
_HALF_SLOPE = 0.04


def soft_edges(images: Tensor) -> Tensor:
    """How much of an edge each pixel is: m^2 / (m^2 + h^2), where m is the slope of the steepest colour.

    Pictures are blurred a little and differentiated with Sobel's operator. Weak slopes, as of noise and
    shading, are held down and strong ones saturate, so that edges look alike however strong they are. That is
    the look of PiDiNet's maps, not their understanding: texture is drawn as well as outlines.

    Args:
        images: [B, 3, H, W] in [0, 1].

    Returns:
        [B, 1, H, W] in [0, 1).
    """
    blur = max(_LEAST_BLUR, _BLUR * min(images.shape[-2:]))
    # Three standard deviations to each side.
    width = 2 * round(3.0 * blur) + 1
    smooth = gaussian_blur2d(images, (width, width), (blur, blur), border_type="replicate")
    # More blur makes the same step less steep.
    slope = blur * spatial_gradient(smooth, mode="sobel", normalized=True).square().sum(2).sqrt()
    strongest = slope.amax(1, keepdim=True).square()
    return strongest / (strongest + _HALF_SLOPE**2)

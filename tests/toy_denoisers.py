"""Denoisers whose estimates and Jacobians are known by formula, in whatever precision the pictures have."""

from __future__ import annotations

import torch
from torch import Tensor

from bigs.guidance import Conditions


class LinearDenoiser:
    """Latents are a strided convolution of the pictures, the estimate a fixed nonlinear function of z_t."""

    detect_edges = None

    def __init__(self, size: int = 8, seed: int = 0, dtype: torch.dtype = torch.float64) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.image_size = size
        self.kernel = torch.randn(4, 3, 2, 2, generator=generator, dtype=dtype)
        self.alphas_cumprod = torch.linspace(0.999, 0.01, 100, dtype=dtype)
        self.asked: list[tuple[Tensor, Tensor, Conditions]] = []

    def encode(self, images: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(2.0 * images - 1.0, self.kernel, stride=2)

    def predict(self, noisy: Tensor, timesteps: Tensor, conditions: Conditions) -> Tensor:
        self.asked.append((noisy, timesteps, conditions))
        return torch.tanh(noisy) + 0.01 * timesteps[:, None, None, None]


class GaussianImages:
    """The exact denoiser of pictures that are `mean` plus white noise of standard deviation `spread`.

    With z = mean + spread n, z_t is Gaussian, too, and the expected noise in it is
    sigma (z_t - alpha mean) / (alpha^2 spread^2 + sigma^2).
    """

    detect_edges = None

    def __init__(self, mean: Tensor, spread: float) -> None:
        self.mean, self.spread = mean, spread
        self.image_size = mean.shape[-1]
        self.alphas_cumprod = torch.linspace(0.999, 0.01, 1000, dtype=mean.dtype)

    def encode(self, images: Tensor) -> Tensor:
        return images

    def predict(self, noisy: Tensor, timesteps: Tensor, conditions: Conditions) -> Tensor:
        a = self.alphas_cumprod[timesteps][:, None, None, None]
        return (1 - a).sqrt() * (noisy - a.sqrt() * self.mean) / (a * self.spread**2 + 1 - a)


def front(count: int = 1) -> Conditions:
    """`count` pictures of the front, without edges."""
    return Conditions(torch.zeros(count), torch.zeros(count))

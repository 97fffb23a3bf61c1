"""A small denoiser of 64 x 64 pictures, conditioned on edges and view, for priors that fit on any disk."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bigs.guidance.denoiser import Conditions, EdgeDetector, classifier_free
from bigs.guidance.edges import soft_edges
from bigs.guidance.fingerprint import fingerprint

PIXELS = 64
_TIMESTEPS = 1000
# Patches of this many pixels a side become channels, so that the network works on 16 x 16 and smaller.
_PATCH = 4


@dataclass(frozen=True)
class PixelConfig:
    """Size of the network; the default has 2.6 million parameters."""

    width: int = 96
    embedding: int = 128


class _Block(nn.Module):
    """Two convolutions with a residual, shifted and scaled by the embedding."""

    def __init__(self, inputs: int, outputs: int, embedding: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.GroupNorm(8, inputs), nn.GroupNorm(8, outputs)
        self.conv1 = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.modulation = nn.Linear(embedding, 2 * outputs)
        self.skip = nn.Conv2d(inputs, outputs, 1) if inputs != outputs else nn.Identity()
        # Zero at the start, so that a fresh block passes its input on.
        with torch.no_grad():
            for parameter in self.conv2.parameters():
                parameter.zero_()

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        hidden = self.conv1(nn.functional.silu(self.norm1(x)))
        scale, shift = self.modulation(embedding)[..., None, None].chunk(2, dim=1)
        hidden = self.norm2(hidden) * (1.0 + scale) + shift
        return self.skip(x) + self.conv2(nn.functional.silu(hidden))


class PixelNet(nn.Module):
    """A U-Net over 4 x 4 patches that predicts the velocity sqrt(a) eps - sqrt(1 - a) x."""

    def __init__(self, config: PixelConfig) -> None:
        super().__init__()
        self.config = config
        width, embedding = config.width, config.embedding
        self.embed = nn.Sequential(
            nn.Linear(2 * _FREQUENCIES + 6, embedding), nn.SiLU(), nn.Linear(embedding, embedding), nn.SiLU()
        )
        self.enter = nn.Conv2d(4 * _PATCH**2, width, 3, padding=1)
        self.fine = nn.ModuleList([_Block(width, width, embedding) for _ in range(2)])
        self.down = nn.Conv2d(width, 2 * width, 3, stride=2, padding=1)
        self.coarse = nn.ModuleList([_Block(2 * width, 2 * width, embedding) for _ in range(2)])
        self.up = nn.Conv2d(2 * width, width, 3, padding=1)
        self.out = nn.ModuleList([_Block(2 * width, width, embedding), _Block(width, width, embedding)])
        self.leave = nn.Conv2d(width, 3 * _PATCH**2, 3, padding=1)

    def forward(self, noisy: Tensor, share: Tensor, edges: Tensor, views: Tensor) -> Tensor:
        """Velocities [B, 3, 64, 64].

        Args:
            noisy: [B, 3, 64, 64].
            share: [B] timesteps as shares of the schedule.
            edges: [B, 1, 64, 64] in [0, 1]; zeros where they are not known.
            views: [B, 6] of `view_features`.
        """
        angles = share[:, None] * torch.exp(torch.linspace(0.0, math.log(1000.0), _FREQUENCIES).to(share))
        embedding = self.embed(torch.cat([angles.sin(), angles.cos(), views], dim=-1))
        patches = nn.functional.pixel_unshuffle(torch.cat([noisy, 2.0 * edges - 1.0], dim=1), _PATCH)
        x = self.enter(patches)
        for block in self.fine:
            x = block(x, embedding)
        deep = self.down(x)
        for block in self.coarse:
            deep = block(deep, embedding)
        deep = self.up(nn.functional.interpolate(deep, scale_factor=2.0, mode="nearest"))
        x = torch.cat([x, deep], dim=1)
        for block in self.out:
            x = block(x, embedding)
        return nn.functional.pixel_shuffle(self.leave(nn.functional.silu(x)), _PATCH)


_FREQUENCIES = 16


def view_features(conditions: Conditions, edges_known: Tensor, view_known: Tensor) -> Tensor:
    """[B, 6]: sine and cosine of azimuth, those of elevation, and which of edges and view are known [B]."""
    azimuths, elevations = conditions.azimuths, conditions.elevations
    angles = torch.stack([azimuths.sin(), azimuths.cos(), elevations.sin(), elevations.cos()], dim=-1)
    known = torch.stack([edges_known, view_known], dim=-1).to(angles)
    return torch.cat([angles * known[:, 1:], known], dim=-1)


def cosine_alphas() -> Tensor:
    """`alphas_cumprod` [1000] of the cosine schedule (Nichol and Dhariwal, 2021), kept off both ends."""
    time = (torch.arange(_TIMESTEPS) + 0.5) / _TIMESTEPS
    alphas = torch.cos((time + 0.008) / 1.008 * math.pi / 2) ** 2
    return alphas.clamp(1e-4, 0.9999)


class PixelDenoiser:
    """A `Denoiser` over a `PixelNet`; its latents are the pictures in [-1, 1]."""

    def __init__(self, net: PixelNet, guidance_scale: float = 2.0, familiar: float | None = None) -> None:
        """
        Args:
            net: trained.
            guidance_scale: see `classifier_free`.
            familiar: see `Denoiser`.
        """
        self.familiar = familiar
        self.net = net.eval().requires_grad_(False)
        self.guidance_scale = guidance_scale
        self.alphas_cumprod = cosine_alphas()
        self.image_size = PIXELS
        self.detect_edges: EdgeDetector | None = soft_edges

    @property
    def fingerprint(self) -> str:
        """See `Denoiser`."""
        return fingerprint(self.net.state_dict(), (self.net.config, self.guidance_scale, self.familiar))

    def encode(self, images: Tensor) -> Tensor:
        """Pictures [B, 3, H, W] in [0, 1] as pictures in [-1, 1]."""
        return 2.0 * images - 1.0

    @torch.no_grad()
    def predict(self, noisy: Tensor, timesteps: Tensor, conditions: Conditions) -> Tensor:
        """The noise [B, 3, H, W]; `classifier_free` between edges and view known, and neither."""
        count = len(noisy)
        edges = torch.zeros_like(noisy[:, :1]) if conditions.edges is None else conditions.edges.to(noisy)
        edges_known = torch.full((count,), conditions.edges is not None)
        yes, no = torch.ones(count, dtype=torch.bool), torch.zeros(count, dtype=torch.bool)
        views = torch.cat(
            [view_features(conditions, edges_known, yes), view_features(conditions, no, no)]
        ).to(noisy)
        share = (timesteps.to(noisy) + 0.5) / _TIMESTEPS
        both = torch.cat([noisy, noisy]), torch.cat([share, share])
        velocity = self.net(*both, torch.cat([edges, torch.zeros_like(edges)]), views)
        a = self.alphas_cumprod.to(noisy)[timesteps][:, None, None, None].repeat(2, 1, 1, 1)
        noise = a.sqrt() * velocity + (1.0 - a).sqrt() * both[0]
        conditional, unconditional = noise.chunk(2)
        return classifier_free(conditional, unconditional, self.guidance_scale)

"""Gaussians with parameters of their own, started from a field's last evaluation."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor, nn

_LEAST_OPACITY, _MOST_OPACITY = 1e-4, 1.0 - 1e-4


class FreeGaussians(nn.Module):
    """Canonical Gaussians around a start; `moved`, `scales`, ... are what the parameters make of it.

    A triplane shows no print on a label and no crease in a palm, and evaluating it in every step costs more
    than the rendering. Optimisation goes on with a displacement, size, opacity and colour for each Gaussian.
    """

    base_points: Tensor
    base_quats: Tensor
    base_log_scales: Tensor
    opacity_logits: Tensor
    color_logits: Tensor
    normals: Tensor
    freedom: Tensor
    # Logarithmic, of any axis.
    most_growth: ClassVar[float] = math.inf

    def __init__(self, count: int) -> None:
        """Room for `count` Gaussians; `start` fills it."""
        super().__init__()
        self.register_buffer("base_points", torch.zeros(count, 3))
        self.register_buffer("base_quats", torch.zeros(count, 4))
        self.register_buffer("base_log_scales", torch.zeros(count, 3))
        self.register_buffer("opacity_logits", torch.zeros(count))
        self.register_buffer("color_logits", torch.zeros(count, 3))
        self.register_buffer("normals", torch.zeros(count, 3))
        # Factor on each Gaussian's residuals, at most 1: one that hardly shows stays as it began.
        self.register_buffer("freedom", torch.ones(count))
        # Along the normal, metres: along the surface there are Gaussians already.
        self.shift = nn.Parameter(torch.zeros(count))
        self.size = nn.Parameter(torch.zeros(count, 3))  # logarithmic
        self.opacity = nn.Parameter(torch.zeros(count))  # logit
        self.color = nn.Parameter(torch.zeros(count, 3))  # logit

    def start(
        self, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, normals: Tensor
    ) -> None:
        """Begin from N Gaussians as `types.Gaussians` has them, and their unit normals [N, 3]."""
        self.base_points.copy_(means)
        self.base_quats.copy_(quats)
        self.base_log_scales.copy_(scales.log())
        self.opacity_logits.copy_(torch.logit(opacities.clamp(_LEAST_OPACITY, _MOST_OPACITY)))
        self.color_logits.copy_(torch.logit(colors.clamp(1e-3, 1.0 - 1e-3)))
        self.normals.copy_(normals)

    @torch.no_grad()
    def release(self, chosen: Tensor) -> None:
        """Let those `chosen` [N] (bool) change as much as any from now on; they stay as they are."""
        free = (self.freedom * chosen)[:, None]
        self.base_points += free * self.shift[:, None] * self.normals
        self.base_log_scales += chosen[:, None] * self._growth
        self.opacity_logits += free[:, 0] * self.opacity
        self.color_logits += free * self.color
        for residual in self.parameters():
            residual[chosen] = 0.0
        self.freedom[chosen] = 1.0

    @property
    def offsets(self) -> Tensor:
        """[N, 3] metres from the start."""
        return (self.freedom * self.shift)[:, None] * self.normals

    @property
    def scales(self) -> Tensor:
        """Standard deviations [N, 3], metres."""
        return (self.base_log_scales + self._growth).exp()

    @property
    def _growth(self) -> Tensor:
        """[N, 3], logarithmic."""
        return (self.freedom[:, None] * self.size).clamp_max(self.most_growth)

    @property
    def opacities(self) -> Tensor:
        """[N] in (0, 1)."""
        return torch.sigmoid(self.opacity_logits + self.freedom * self.opacity)

    @property
    def colors(self) -> Tensor:
        """[N, 3] in (0, 1)."""
        return torch.sigmoid(self.color_logits + self.freedom[:, None] * self.color)

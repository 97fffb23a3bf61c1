"""The three decoders of paper section 3.2: appearance f_A, geometry f_G and skinning weights f_D.

Each ends in heads whose last layer starts at zero and whose output is *added* to a start value in the
head's own space (logits, logarithms, 6-D rotations). A fresh decoder therefore reproduces the start
(skinning weights to 2e-3, for the sake of finite logarithms), which replaces the released code's 7500-step
fit of the network to the same values. While its heads are zero and do not learn it gives that start without
any work.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from bigs.geometry.rotations import rot6d_to_matrix


@dataclass(frozen=True)
class DecoderConfig:
    """Widths of the decoders; the released code's values."""

    appearance_width: int = 64
    geometry_width: int = 128
    skinning_width: int = 128


class Appearance(NamedTuple):
    colors: Tensor  # [N, 3] in [0, 1]
    opacities: Tensor  # [N] in [0, 1]


class Geometry(NamedTuple):
    offsets: Tensor  # [N, 3] metres
    rotations: Tensor  # [N, 3, 3]
    log_scales: Tensor  # [N, 3], added to the start's logarithms


def trunk(in_features: int, width: int) -> nn.Sequential:
    """Two hidden layers with GELU."""
    return nn.Sequential(nn.Linear(in_features, width), nn.GELU(), nn.Linear(width, width), nn.GELU())


def zero_head(in_features: int, out_features: int) -> nn.Linear:
    """A linear layer that starts as the zero function."""
    layer = nn.Linear(in_features, out_features)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def is_fresh(*heads: nn.Linear) -> bool:
    """Whether heads give zero whatever their input, now and after the next step."""
    return not any(p.requires_grad or bool(p.any()) for head in heads for p in head.parameters())


class AppearanceDecoder(nn.Module):
    """f_A: features to colour and opacity, added to start values as logits."""

    def __init__(self, in_features: int, width: int) -> None:
        super().__init__()
        self.trunk = trunk(in_features, width)
        self.color = zero_head(width, 3)
        self.opacity = zero_head(width, 1)

    def forward(self, features: Tensor, color_logits: Tensor, opacity_logits: Tensor) -> Appearance:
        """Features [N, F] and starts [N, 3], [N] to colours and opacities in (0, 1)."""
        hidden = self.trunk(features)
        return Appearance(
            torch.sigmoid(self.color(hidden) + color_logits),
            torch.sigmoid(self.opacity(hidden)[:, 0] + opacity_logits),
        )


class GeometryDecoder(nn.Module):
    """f_G: features to offset, rotation and scale relative to the start."""

    def __init__(self, in_features: int, width: int, max_offset: float, max_log_scale: float = 1.5) -> None:
        """`max_offset` (metres) and `max_log_scale` bound what the field may change: tanh keeps a Gaussian
        near the surface it belongs to, however strong the image gradient."""
        super().__init__()
        self.trunk = trunk(in_features, width)
        self.offset = zero_head(width, 3)
        self.rotation = zero_head(width, 6)
        self.scale = zero_head(width, 3)
        self.max_offset = max_offset
        self.max_log_scale = max_log_scale
        self.register_buffer("identity6d", torch.tensor([1.0, 0.0, 0.0, 0.0, 1.0, 0.0]), persistent=False)

    def forward(self, features: Tensor) -> Geometry:
        """Features [N, F] to offsets [N, 3] (metres), rotations [N, 3, 3] and log scales [N, 3]."""
        if is_fresh(self.offset, self.rotation, self.scale):
            zeros = features.new_zeros(len(features), 3)
            return Geometry(zeros, torch.eye(3, dtype=features.dtype).expand(len(features), 3, 3), zeros)
        hidden = self.trunk(features)
        return Geometry(
            self.max_offset * torch.tanh(self.offset(hidden)),
            rot6d_to_matrix(self.rotation(hidden) + self.identity6d),
            self.max_log_scale * torch.tanh(self.scale(hidden)),
        )


class SkinningDecoder(nn.Module):
    """f_D: features to LBS weights over the joints, a softmax of start logits plus the field (Eq. 3)."""

    def __init__(self, in_features: int, width: int, joints: int = 16) -> None:
        super().__init__()
        self.trunk = trunk(in_features, width)
        self.weights = zero_head(width, joints)

    def forward(self, features: Tensor, start_weights: Tensor) -> Tensor:
        """Features [N, F] and start weights [N, J] to weights [N, J] that sum to one."""
        # 1e-4 keeps the logarithm finite where the template has no weight; such a joint can still gain some.
        start = torch.log(start_weights + 1e-4)
        if is_fresh(self.weights):
            return torch.softmax(start, dim=-1)
        return torch.softmax(self.weights(self.trunk(features)) + start, dim=-1)

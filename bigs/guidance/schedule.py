"""The noise of the pictures that the prior judges, and the weight of its gradient."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from bigs.checks import InputError, check_choice

Weighting = Literal["sigma2", "alpha_sigma2", "uniform"]
WEIGHTINGS: tuple[Weighting, ...] = ("sigma2", "alpha_sigma2", "uniform")


@dataclass(frozen=True)
class SdsConfig:
    """Choices of score distillation. Timesteps are fractions of the model's schedule: 1 is pure noise."""

    t_first: tuple[float, float] = (0.5, 0.98)  # range at progress 0: noise hides all but the rough shape
    t_last: tuple[float, float] = (0.02, 0.3)  # range at progress 1: only detail is left to judge
    weighting: Weighting = "sigma2"
    max_grad_norm: float | None = None  # limit of the norm of each latent's gradient

    def __post_init__(self) -> None:
        for name in ("t_first", "t_last"):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high <= 1.0:
                raise InputError(f"{name}: expected 0 <= low <= high <= 1, found ({low}, {high})")
        check_choice("weighting", self.weighting, WEIGHTINGS)
        if self.max_grad_norm is not None and not self.max_grad_norm > 0.0:
            raise InputError(f"max_grad_norm: expected more than 0, found {self.max_grad_norm}")


def timestep_range(config: SdsConfig, progress: float, n_timesteps: int) -> tuple[int, int]:
    """First and last timestep, both included, that are drawn when a share `progress` of the steps is done.

    Both ends move evenly from `t_first` to `t_last`. Progress outside [0, 1] counts as its nearer end.
    """
    done = min(max(progress, 0.0), 1.0)
    low, high = (
        round((first + done * (last - first)) * (n_timesteps - 1))
        for first, last in zip(config.t_first, config.t_last, strict=True)
    )
    return low, high


def timestep_weight(weighting: Weighting, alphas_cumprod: Tensor, timesteps: Tensor) -> Tensor:
    """w(t) of paper Eq. 7, [B], from the model's own schedule.

    - `sigma2`: 1 - a_t, the variance of the noise, as DreamFusion and the paper's released code have it;
    - `alpha_sigma2`: sqrt(a_t) (1 - a_t), which counts the noisiest pictures less;
    - `uniform`: 1.
    """
    alphas = alphas_cumprod[timesteps]
    if weighting == "uniform":
        return torch.ones_like(alphas)
    variance = 1.0 - alphas
    return variance if weighting == "sigma2" else alphas.sqrt() * variance

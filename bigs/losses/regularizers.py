"""What keeps fields and poses plausible where images say nothing."""

from __future__ import annotations

from torch import Tensor


def color_spread(colors: Tensor) -> Tensor:
    """Mean over N colours c [N, 3] of ||c - mean c||_1 (the paper's L_color, Eq. 5)."""
    return (colors - colors.mean(0)).abs().mean(0).sum()


def scale_size(scales: Tensor) -> Tensor:
    """Mean over N Gaussians of ||s||^2 for standard deviations s [N, 3], metres (paper's L_scale, Eq. 5)."""
    return scales.square().sum() / len(scales)


def lbs_deviation(weights: Tensor, target: Tensor) -> Tensor:
    """||W - W_near||_F^2 / N (Eq. 6): skinning weights [N, J] against those of the 6 nearest vertices."""
    return (weights - target).square().sum() / len(weights)


def squared_norm(residuals: Tensor) -> Tensor:
    """Mean of ||r||^2 over residuals r [..., D], in their own unit squared: a normal prior around zero."""
    return residuals.square().sum() * (residuals.shape[-1] / residuals.numel())

"""What keeps fields and poses plausible where images say nothing."""

from __future__ import annotations

from torch import Tensor


def color_spread(colors: Tensor) -> Tensor:
    """Mean distance of the colours [N, 3] from their mean (paper's L_color)."""
    return (colors - colors.mean(0)).abs().mean(0).sum()


def scale_size(scales: Tensor) -> Tensor:
    """Mean squared standard deviation [N, 3], metres squared, summed over axes (paper's L_scale)."""
    return scales.square().mean(0).sum()


def lbs_deviation(weights: Tensor, target: Tensor) -> Tensor:
    """Squared Frobenius distance of LBS weights [N, J] from the 6-neighbour target, per Gaussian (Eq. 6)."""
    return (weights - target).square().sum() / len(weights)


def squared_norm(residuals: Tensor) -> Tensor:
    """Mean squared length of vectors [..., D]: the prior on a residual."""
    return residuals.square().sum(-1).mean()

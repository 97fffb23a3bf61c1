"""Robust local-linear smoothing of trajectories of vectors and rotations over time."""

from __future__ import annotations

import torch
from torch import Tensor

from bigs.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, mean_rotation


def interpolated_frames(values: Tensor, tolerance: float = 1e-6) -> Tensor:
    """Frames [T] (bool) that look interpolated: a straight line through both neighbours.

    Estimators fill gaps linearly; measured frames never have a second difference of exactly zero.

    Args:
        values: [T, D] positions.
        tolerance: largest second difference, in units of `values`.
    """
    frames = torch.zeros(len(values), dtype=torch.bool)
    if len(values) > 2:
        second = values[2:] - 2.0 * values[1:-1] + values[:-2]
        frames[1:-1] = second.abs().amax(-1) < tolerance
    return frames


def smooth_vectors(values: Tensor, weights: Tensor, sigma: float) -> Tensor:
    """Local-linear fit with Gaussian weights in time, made robust by re-weighting (Tukey's biweight).

    Args:
        values: [T, D].
        weights: [T] trust in each frame, 0 to leave it out.
        sigma: width of the window in frames; 0 returns `values`.

    Returns:
        [T, D].
    """
    if sigma <= 0 or len(values) < 3:
        return values
    offsets, near = _window(len(values), sigma)
    trust = weights.clone()
    for _ in range(3):
        fitted = _local_linear(values[near.index], offsets, _window_weights(near, trust))
        trust = weights * _tukey((values - fitted).norm(dim=-1), weights)
    return fitted


def smooth_rotations(rotations: Tensor, weights: Tensor, sigma: float) -> Tensor:
    """The same on SO(3): a local-linear fit in the tangent space at each window's robust mean.

    Args:
        rotations: [..., T, 3, 3], such as one trajectory for each joint.
        weights: [T] trust in each frame.
        sigma: width of the window in frames; 0 returns `rotations`.

    Returns:
        [..., T, 3, 3].
    """
    frames = rotations.shape[-3]
    if sigma <= 0 or frames < 3:
        return rotations
    offsets, near = _window(frames, sigma)
    windows = rotations[..., near.index, :, :]  # [..., T, W, 3, 3]
    trust = weights.clone()
    for _ in range(3):
        window_weights = _window_weights(near, trust)
        centre = mean_rotation(windows, window_weights)
        tangent = matrix_to_axis_angle(centre[..., None, :, :].transpose(-1, -2) @ windows)
        fitted = centre @ axis_angle_to_matrix(_local_linear(tangent, offsets, window_weights))
        error = matrix_to_axis_angle(fitted.transpose(-1, -2) @ rotations).norm(dim=-1)
        trust = weights * _tukey(error, weights)
    return fitted


# Residuals (metres, radians, or pixels over focal length) below this are smaller than any estimator's error.
_EXACT = 1e-3


class _Near:
    """For every frame, the frames of its window [T, W] and their weights [T, W] (0 outside the clip)."""

    def __init__(self, index: Tensor, weight: Tensor) -> None:
        self.index = index
        self.weight = weight


def _window(frames: int, sigma: float) -> tuple[Tensor, _Near]:
    reach = min(int(3 * sigma + 1), frames - 1)
    offsets = torch.arange(-reach, reach + 1)
    index = torch.arange(frames)[:, None] + offsets
    inside = (index >= 0) & (index < frames)
    weight = torch.exp(-0.5 * (offsets / sigma) ** 2) * inside
    return offsets.float(), _Near(index.clamp(0, frames - 1), weight)


def _window_weights(near: _Near, trust: Tensor) -> Tensor:
    """Weights [..., T, W] of a window's frames; where none is trusted, their nearness alone."""
    weights = near.weight * trust[..., near.index]
    return torch.where(weights.sum(-1, keepdim=True) > 1e-6, weights, near.weight)


def _local_linear(values: Tensor, offsets: Tensor, weights: Tensor) -> Tensor:
    """Value at offset 0 of a weighted line through each window: [..., W, D], [W], [..., W] to [..., D]."""
    weights = weights / weights.sum(-1, keepdim=True)
    mean_x = (weights * offsets).sum(-1, keepdim=True)
    mean_y = (weights[..., None] * values).sum(-2)
    centred = offsets - mean_x
    variance = (weights * centred**2).sum(-1, keepdim=True)
    slope = (weights[..., None] * centred[..., None] * values).sum(-2) / variance.clamp_min(1e-3)
    return mean_y - slope * mean_x


def _tukey(residuals: Tensor, weights: Tensor) -> Tensor:
    """Tukey's biweight of residual norms [..., T], with a cut-off from their own median."""
    # Interpolated frames fit a line exactly and would pull the median to zero.
    trusted = residuals[..., weights > 0.5 * weights.max()]
    if trusted.shape[-1] == 0:
        return torch.ones_like(residuals)
    # 1.48 median estimates a standard deviation; 4.685 of those is the usual cut-off. Norms of 3-vectors
    # have a larger median than one coordinate's absolute value, so this errs on the side of keeping frames.
    # A still clip has a median of zero too: nothing within _EXACT is an outlier.
    cut = 4.685 * 1.48 * trusted.median(-1, keepdim=True).values.clamp_min(_EXACT)
    return (1.0 - (residuals / cut).clamp(max=1.0) ** 2) ** 2

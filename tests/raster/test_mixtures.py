"""Scenes nobody made by hand: random mixtures of hostile kinds against the float64 oracle."""

from typing import Any

import pytest
import torch
from raster_mixtures import mixture
from raster_oracle import gradients as oracle_gradients
from raster_scenes import DIFFERENTIABLE, gradients, relative

from bigs.raster import RasterSettings

Result = tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]


def errors(got: Result, truth: Result) -> tuple[float, float]:
    """Of image and alphas, and the largest of the gradients. A faint alpha is 1 - T with T next to 1."""
    faint = max(truth[1].abs().max().item(), 0.05) * truth[1].numel() ** 0.5
    alphas = (got[1].double() - truth[1]).norm().item() / faint
    return max(relative(got[0], truth[0]), alphas), max(relative(got[2][k], truth[2][k]) for k in truth[2])


def truth_of(inputs: dict[str, Any], settings: RasterSettings) -> Result:
    names = tuple(name for name in DIFFERENTIABLE if name in inputs)
    return oracle_gradients(inputs, names, settings)


def moved(inputs: dict[str, Any], seed: int) -> dict[str, Any]:
    """Every number but the camera's last row by up to half a bit of float32."""
    generator = torch.Generator().manual_seed(seed)
    result = dict(inputs)
    for name, value in inputs.items():
        if isinstance(value, torch.Tensor):
            noise = 2 * torch.rand(value.shape, generator=generator, dtype=value.dtype) - 1
            result[name] = value * (1 + 2.0**-24 * noise)
    result["viewmats"][:, 3] = inputs["viewmats"][:, 3]
    return result


# Seed 22 has a Gaussian so wide that a gradient overflowed in float32.
@pytest.mark.parametrize("seed", range(24))
def test_mixtures(seed):
    inputs, settings = mixture(seed)
    truth = truth_of(inputs, settings)
    image, gradient = errors(gradients(inputs, settings=settings), truth)
    assert image < 1e-11 and gradient < 1e-9
    single = {k: v.float() if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}
    image, gradient = errors(gradients(single, settings=settings), truth)
    moves = [errors(truth_of(moved(inputs, seed), settings), truth) for seed in (1, 2)]
    assert image < max(3e-6, *(10 * move for move, _ in moves))
    assert gradient < max(1e-4, *(10 * move for _, move in moves))

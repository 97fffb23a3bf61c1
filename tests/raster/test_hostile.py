"""Hostile scenes: image and every gradient against a float64 oracle.

`python tests/raster/test_hostile.py` prints the measured errors, the table of docs/stability.md.
"""

from functools import cache
from typing import Any

import pytest
import torch
from raster_hostile import HOSTILE, odd_ones
from raster_oracle import exact_whitening, footprints
from raster_oracle import gradients as oracle_gradients
from raster_scenes import DIFFERENTIABLE, gradients, relative

OF_GAUSSIANS = ("means", "quats", "scales", "opacities", "colors")


@cache
def scene_of(name: str) -> dict[str, Any]:
    return HOSTILE[name].build()


@cache
def truth(name: str) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
    return oracle_gradients(scene_of(name), DIFFERENTIABLE, HOSTILE[name].settings)


def errors(name: str, dtype: torch.dtype, inputs: dict[str, Any] | None = None) -> tuple[float, float]:
    """Relative L2 error of the image, and the largest of the gradients (also of the hostile ones alone)."""
    given = {
        k: v.to(dtype) if isinstance(v, torch.Tensor) else v for k, v in (inputs or scene_of(name)).items()
    }
    colors, alphas, grads = gradients(given, settings=HOSTILE[name].settings)
    assert colors.isfinite().all() and alphas.isfinite().all()
    assert (alphas >= 0).all() and (alphas <= 1).all()
    true_colors, true_alphas, true_grads = truth(name)
    odd = odd_ones(scene_of(name))
    of_gradients = [relative(grads[k], true_grads[k]) for k in DIFFERENTIABLE]
    of_gradients += [relative(grads[k][odd], true_grads[k][odd]) for k in OF_GAUSSIANS]
    assert all(grad.isfinite().all() for grad in grads.values())
    return max(relative(colors, true_colors), relative(alphas, true_alphas)), max(of_gradients)


def moved_by_half_a_bit(name: str) -> tuple[float, float]:
    """How far the truth goes when the inputs move by half a bit of float32; the worse of two tries."""
    generator = torch.Generator().manual_seed(1)
    true_colors, true_alphas, true_grads = truth(name)
    worst = [0.0, 0.0]
    for _ in range(2):
        moved = {
            k: v * (1 + 2.0**-24 * (2 * torch.rand(v.shape, generator=generator, dtype=v.dtype) - 1))
            if isinstance(v, torch.Tensor)
            else v
            for k, v in scene_of(name).items()
        }
        moved["viewmats"][:, 3] = scene_of(name)["viewmats"][:, 3]
        colors, alphas, grads = oracle_gradients(moved, DIFFERENTIABLE, HOSTILE[name].settings)
        worst[0] = max(worst[0], relative(colors, true_colors), relative(alphas, true_alphas))
        worst[1] = max([worst[1], *(relative(grads[k], true_grads[k]) for k in DIFFERENTIABLE)])
    return worst[0], worst[1]


@pytest.mark.parametrize("name", HOSTILE)
def test_double_precision(name):
    image, gradient = errors(name, torch.float64)
    assert image < 1e-12 and gradient < 1e-10


@pytest.mark.parametrize("name", HOSTILE)
def test_single_precision(name):
    case = HOSTILE[name]
    image, gradient = errors(name, torch.float32)
    allowed = (case.image, case.gradient)
    if case.touchy:
        allowed = tuple(3 * moved for moved in moved_by_half_a_bit(name))
    assert image < allowed[0] and gradient < allowed[1]


@pytest.mark.parametrize("name", HOSTILE)
def test_the_oracle_agrees_with_60_digits(name):
    settings = HOSTILE[name].settings
    screen = footprints({k: v[:400] if k in OF_GAUSSIANS else v for k, v in scene_of(name).items()}, settings)
    exact = exact_whitening(screen.rows, settings.eps2d)
    assert ((screen.whitening - exact).abs() <= 1e-12 * exact.abs().amax(-1, keepdim=True)).all()


if __name__ == "__main__":
    print("| scene | f32 image | f32 gradient | f64 image | f64 gradient |\n|---|---|---|---|---|")
    for name, case in HOSTILE.items():
        cells = [f"{e:.0e}" for dtype in (torch.float32, torch.float64) for e in errors(name, dtype)]
        if case.touchy:
            moved = moved_by_half_a_bit(name)
            cells[0] += f" ({moved[0]:.0e})"
            cells[1] += f" ({moved[1]:.0e})"
        print(f"| {name} | {' | '.join(cells)} |")

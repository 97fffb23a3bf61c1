"""How well a prior knows pictures: a formula, where the exact prior is known."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from toy_denoisers import GaussianImages, front

from bigs.checks import InputError
from bigs.guidance.pixel import PixelConfig, PixelNet
from bigs.guidance.pixel_file import load_pixel_denoiser, save_pixel_net
from bigs.guidance.residual import picture_residual


@pytest.mark.parametrize("apart", [0.0, 0.3])
def test_it_is_that_of_the_exact_denoiser(apart: float) -> None:
    """Of pictures `apart` from what it believes: (s^4 d^2 + s^2 a^2 v^4) / (a^2 v^2 + s^2)^2."""
    spread = 0.4
    denoiser = GaussianImages(torch.full((1, 3, 32, 32), 0.5), spread)
    a = float(denoiser.alphas_cumprod[round(0.9 * 999)])
    expected = ((1 - a) ** 2 * apart**2 + (1 - a) * a * spread**4) / (a * spread**2 + 1 - a) ** 2
    images = torch.full((8, 3, 32, 32), 0.5 + apart)
    assert picture_residual(denoiser, images, front(8)) == pytest.approx(expected, rel=0.03)


def test_the_same_seed_gives_the_same_value() -> None:
    denoiser = GaussianImages(torch.full((1, 3, 8, 8), 0.5), 0.1)
    images = torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    values = [picture_residual(denoiser, images, front(2), seed) for seed in (0, 0, 1)]
    assert values[0] == values[1] != values[2]


def test_a_file_that_does_not_say_what_it_knows_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "prior.safetensors"
    save_pixel_net(path, PixelNet(PixelConfig(width=16, embedding=32)), 0.1)
    path.write_bytes(path.read_bytes().replace(b"familiar", b"familjar"))
    with pytest.raises(InputError, match="with parts missing"):
        load_pixel_denoiser(path)

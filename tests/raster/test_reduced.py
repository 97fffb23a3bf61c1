"""Small pictures against large ones that were reduced by taking means."""

import pytest
import torch
from raster_scenes import scene

from bigs.raster import RasterSettings, rasterization

SIDE = 96


def picture(inputs: dict, reduction: int, settings: RasterSettings) -> torch.Tensor:
    scaled = torch.diag(torch.tensor([1.0 / reduction, 1.0 / reduction, 1.0], dtype=torch.float64))
    sides = {"width": SIDE // reduction, "height": SIDE // reduction}
    return rasterization(**{**inputs, "Ks": scaled @ inputs["Ks"], **sides}, settings=settings).colors


def reduced(image: torch.Tensor, reduction: int) -> torch.Tensor:
    flat = image.flatten(0, -4).movedim(-1, 1)
    return (
        torch.nn.functional.avg_pool2d(flat, reduction)
        .movedim(1, -1)
        .reshape(*image.shape[:-3], SIDE // reduction, SIDE // reduction, image.shape[-1])
    )


@pytest.mark.parametrize("reduction", [2, 4])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_small_picture_is_the_large_one_reduced(reduction: int, seed: int) -> None:
    settings = RasterSettings()
    # Gaussians of a pixel or two of the large picture, faint: then what each adds is nearly its own.
    inputs = scene(n=60, width=SIDE, height=SIDE, seed=seed)
    inputs["scales"] = inputs["scales"] * 0.15
    expected = reduced(picture(inputs, 1, settings), reduction)
    off = (picture(inputs, reduction, settings.reduced(1.0 / reduction)) - expected).abs().mean()
    as_it_is = (picture(inputs, reduction, settings) - expected).abs().mean()
    assert off < 0.35 * as_it_is


def test_a_picture_that_is_not_reduced_keeps_its_settings() -> None:
    settings = RasterSettings(eps2d=0.2)
    assert settings.reduced(1.0) == settings

"""How well a prior knows pictures: a formula where the exact one is known, and a prior that was trained."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import trimesh
from procedural_meshes import write_meshes
from toy_denoisers import GaussianImages, front

from bigs.checks import InputError
from bigs.commands.prior.train import mesh_pictures, train_prior
from bigs.guidance import Conditions
from bigs.guidance.pixel import PixelConfig, PixelNet
from bigs.guidance.pixel_file import load_pixel_denoiser, save_pixel_net
from bigs.guidance.pixel_training import PixelTrainingConfig
from bigs.guidance.residual import picture_residual
from bigs.train.plan.config import GuidanceStage


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


@pytest.mark.slow
def test_a_trained_prior_leaves_out_an_unlike_object(tmp_path: Path) -> None:
    """Pale boxes, cans and bottles were learned; a dark bracket, which no mirror plane halves, was not."""
    write_meshes(tmp_path / "meshes", 6, 0)
    config = PixelTrainingConfig(steps=150, batch=8, lr=2e-3, net=PixelConfig(width=16, embedding=32))
    train_prior(tmp_path / "meshes", tmp_path / "prior.safetensors", config, views=12, device="cpu")
    prior = load_pixel_denoiser(tmp_path / "prior.safetensors")
    write_meshes(tmp_path / "others", 3, 10_000)
    arm, foot = trimesh.creation.box((0.16, 0.03, 0.04)), trimesh.creation.box((0.03, 0.1, 0.02))
    foot.apply_translation((0.06, 0.06, 0.01))
    bracket = trimesh.util.concatenate([arm, foot])
    bracket.visual = trimesh.visual.ColorVisuals(bracket, vertex_colors=[20, 20, 40, 255])
    bracket.export(tmp_path / "bracket.ply")

    def strangeness(file: Path) -> float:
        images, azimuths, elevations = mesh_pictures(file, 12, "z", 0)
        asked = Conditions(azimuths, elevations)
        return picture_residual(prior, images.float() / 255.0, asked) / prior.familiar

    alike = sorted(strangeness(file) for file in (tmp_path / "others").glob("*.ply"))
    assert alike[1] < GuidanceStage().unlike < 1.5 < strangeness(tmp_path / "bracket.ply")


def test_a_file_that_does_not_say_what_it_knows_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "prior.safetensors"
    save_pixel_net(path, PixelNet(PixelConfig(width=16, embedding=32)), 0.1)
    path.write_bytes(path.read_bytes().replace(b"familiar", b"familjar"))
    with pytest.raises(InputError, match="with parts missing"):
        load_pixel_denoiser(path)

"""The small prior: its algebra, its training, its file, and the command that makes it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from procedural_meshes import write_meshes

from bigs.checks import InputError
from bigs.commands.prior.train import mesh_pictures, train_prior
from bigs.guidance import Conditions, SdsConfig, sds_loss
from bigs.guidance.pixel import PIXELS, PixelConfig, PixelDenoiser, PixelNet, cosine_alphas
from bigs.guidance.pixel_file import load_pixel_denoiser, save_pixel_net
from bigs.guidance.pixel_training import Pictures, PixelTraining, PixelTrainingConfig
from bigs.guidance.sds import add_noise

SMALL = PixelConfig(width=16, embedding=32)
CPU = torch.device("cpu")


def conditions(count: int) -> Conditions:
    return Conditions(torch.zeros(count), torch.zeros(count))


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("meshes")
    write_meshes(folder, 3, 0)
    return folder


def config(steps: int) -> PixelTrainingConfig:
    return PixelTrainingConfig(steps=steps, batch=4, lr=2e-3, net=SMALL)


def test_the_default_has_less_than_five_million_parameters() -> None:
    count = sum(p.numel() for p in PixelNet(PixelConfig()).parameters())
    assert 1_000_000 < count < 5_000_000


def test_the_noise_follows_from_the_velocity() -> None:
    """A network that knows the picture, and so the true velocity, gives back the true noise."""
    clean = torch.rand(2, 3, PIXELS, PIXELS, generator=torch.Generator().manual_seed(0)) * 2.0 - 1.0
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(1))
    timesteps = torch.tensor([100, 900])
    alphas = cosine_alphas()
    noisy = add_noise(clean, noise, timesteps, alphas)
    a = alphas[timesteps][:, None, None, None]

    class Knowing(PixelNet):
        def forward(self, *arguments: torch.Tensor) -> torch.Tensor:
            return (a.sqrt() * noise - (1.0 - a).sqrt() * clean).repeat(2, 1, 1, 1)

    found = PixelDenoiser(Knowing(SMALL)).predict(noisy, timesteps, conditions(2))
    torch.testing.assert_close(found, noise, atol=1e-4, rtol=1e-4)


def test_edges_and_view_change_the_estimate() -> None:
    torch.manual_seed(0)
    net = PixelNet(SMALL)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
    denoiser = PixelDenoiser(net)
    noisy = torch.randn(1, 3, PIXELS, PIXELS)
    edges = torch.rand(1, 1, PIXELS, PIXELS)
    estimates = [
        denoiser.predict(noisy, torch.tensor([500]), asked)
        for asked in (
            conditions(1),
            conditions(1)._replace(edges=edges),
            Conditions(torch.ones(1), torch.zeros(1)),
            Conditions(torch.zeros(1), torch.ones(1)),
        )
    ]
    for other in estimates[1:]:
        assert float((other - estimates[0]).abs().max()) > 1e-4


def test_sds_reaches_the_picture() -> None:
    torch.manual_seed(0)
    denoiser = PixelDenoiser(PixelNet(SMALL))
    images = torch.rand(2, 3, 48, 48, requires_grad=True)
    generator = torch.Generator().manual_seed(0)
    sds_loss(denoiser, images, conditions(2), SdsConfig(), progress=0.0, generator=generator).backward()
    assert images.grad is not None and float(images.grad.abs().max()) > 0


def test_training_learns(meshes: Path) -> None:
    """The error falls below that of the untrained network, which predicts nearly nothing."""
    images, azimuths, elevations = mesh_pictures(meshes / "000000.ply", 6, "z", 0)
    training = PixelTraining(config(60), CPU)
    losses = [training.take_step(Pictures(images, azimuths, elevations)) for _ in range(60)]
    assert sum(losses[-10:]) < 0.85 * sum(losses[:10])


def test_pictures_show_the_mesh_on_white(meshes: Path) -> None:
    images, azimuths, elevations = mesh_pictures(meshes / "000001.ply", 8, "z", 0)
    assert images.shape == (8, 3, PIXELS, PIXELS) and images.dtype == torch.uint8
    assert (images[:, :, 0, 0] == 255).all()
    shares = (images.amin(1) < 245).float().mean((1, 2))
    assert (shares > 0.05).all() and (shares < 0.7).all()
    assert float(elevations.max()) > 0.5 > -0.5 > float(elevations.min())
    # Another seed, another front.
    assert not torch.allclose(azimuths, mesh_pictures(meshes / "000001.ply", 8, "z", 1)[1])


class _Stopped(Exception):
    pass


def test_stopped_and_resumed_it_ends_the_same(meshes: Path, tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole.safetensors", tmp_path / "parts.safetensors"
    train_prior(meshes, whole, config(6), views=4, device="cpu")

    def stop(event: dict[str, object]) -> None:
        if event["event"] == "step" and event["step"] == 5:
            raise _Stopped

    with pytest.raises(_Stopped):
        train_prior(meshes, parts, config(6), views=4, device="cpu", keep_every=2, listen=stop)
    assert not parts.exists()
    with pytest.raises(InputError, match="pass --resume"):
        train_prior(meshes, parts, config(6), views=4, device="cpu")
    found = train_prior(meshes, parts, config(6), views=4, device="cpu", resume=True)
    assert found.steps == 2 and (found.meshes, found.pictures) == (3, 12)
    assert whole.read_bytes() == parts.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["parts.safetensors", "whole.safetensors"]


def test_a_state_of_other_options_is_refused(meshes: Path, tmp_path: Path) -> None:
    out = tmp_path / "prior.safetensors"

    def stop(event: dict[str, object]) -> None:
        if event["event"] == "step" and event["step"] == 2:
            raise _Stopped

    with pytest.raises(_Stopped):
        train_prior(meshes, out, config(3), views=4, device="cpu", keep_every=1, listen=stop)
    with pytest.raises(InputError, match="found one of others"):
        train_prior(meshes, out, config(3), views=5, device="cpu", resume=True)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda path: path.unlink(), "found no such file"),
        (lambda path: path.write_bytes(b"no"), "damaged"),
        (lambda path: path.write_bytes(path.read_bytes()[:-40]), "damaged"),
    ],
)
def test_a_bad_file_is_named(tmp_path: Path, spoil: Callable[[Path], object], message: str) -> None:
    path = tmp_path / "prior.safetensors"
    save_pixel_net(path, PixelNet(SMALL), 0.1)
    prior = load_pixel_denoiser(path)
    assert (prior.image_size, prior.familiar) == (PIXELS, 0.1)
    spoil(path)
    with pytest.raises(InputError, match=message):
        load_pixel_denoiser(path)


def test_a_folder_without_meshes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected meshes"):
        train_prior(tmp_path, tmp_path / "out.safetensors", config(1), device="cpu")
    (tmp_path / "bad.ply").write_text("nothing")
    with pytest.raises(InputError, match=r"bad\.ply: expected a"):
        train_prior(tmp_path, tmp_path / "out.safetensors", config(1), device="cpu")

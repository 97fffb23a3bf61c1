"""Eq. 7 from the latents through the splatting engine to the object's Gaussians and their field."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from toy_denoisers import LinearDenoiser, front

from bigs.fields.decoders import DecoderConfig
from bigs.fields.triplane import TriplaneConfig
from bigs.guidance import SdsConfig, sds_loss
from bigs.models.object_splats import ObjectSplats, ObjectSplatsConfig
from bigs.raster import RasterSettings, rasterization

SIZE = 24
# A picture without thresholds is smooth in its parameters, so that finite differences converge.
EXACT = RasterSettings(alpha_threshold=0.0, min_transmittance=0.0)
CONFIG = SdsConfig(t_first=(0.4, 0.4), t_last=(0.4, 0.4))


def fibonacci_ball(count: int) -> np.ndarray:
    """`count` unit vectors, spread evenly."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=-1)


def make_gaussians() -> dict[str, Tensor]:
    """A ball of 20 Gaussians half a metre before the camera, in float64."""
    generator = torch.Generator().manual_seed(5)
    count = 20
    return {
        "means": torch.as_tensor(0.05 * fibonacci_ball(count)) + torch.tensor([0.0, 0.0, 0.5]).double(),
        "quats": torch.randn(count, 4, generator=generator, dtype=torch.float64),
        "scales": 0.01 + 0.01 * torch.rand(count, 3, generator=generator, dtype=torch.float64),
        "opacities": torch.full((count,), 0.6, dtype=torch.float64),
        "colors": torch.rand(count, 3, generator=generator, dtype=torch.float64),
    }


def render(gaussians: dict[str, Tensor], backend: str = "rust", background: float = 1.0) -> Tensor:
    """[1, 3, SIZE, SIZE]"""
    like = gaussians["means"]
    K = torch.tensor([[90.0, 0, SIZE / 2], [0, 90.0, SIZE / 2], [0, 0, 1]], dtype=like.dtype)
    output = rasterization(
        **gaussians,
        viewmats=torch.eye(4, dtype=like.dtype)[None],
        Ks=K[None],
        width=SIZE,
        height=SIZE,
        settings=EXACT,
        backgrounds=torch.full((1, 3), background, dtype=like.dtype),
        backend=backend,
    )
    return output.colors.permute(0, 3, 1, 2)


def loss_of(denoiser: LinearDenoiser, images: Tensor) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return sds_loss(denoiser, images, front(), CONFIG, progress=0.0, generator=generator)


def gradient_at_latents(denoiser: LinearDenoiser, latents: Tensor) -> Tensor:
    """w(t) (eps_hat - eps), from what the denoiser was asked."""
    noisy, timesteps, _ = denoiser.asked[-1]
    a = denoiser.alphas_cumprod[timesteps][:, None, None, None]
    noise = (noisy - a.sqrt() * latents) / (1 - a).sqrt()
    return (1 - a) * (denoiser.predict(noisy, timesteps, front()) - noise)


def test_the_objects_gaussians_get_the_formula_times_both_jacobians() -> None:
    """Against central differences of <w (eps_hat - eps), encode(render(gaussians))> with the bracket held."""
    denoiser, start = LinearDenoiser(SIZE), make_gaussians()
    gaussians = {name: values.clone().requires_grad_() for name, values in start.items()}
    loss_of(denoiser, render(gaussians)).backward()
    with torch.no_grad():
        bracket = gradient_at_latents(denoiser, denoiser.encode(render(start)))
    directions = torch.Generator().manual_seed(2)
    for name, values in gaussians.items():
        for _ in range(3):
            direction = torch.randn(values.shape, generator=directions, dtype=torch.float64)
            shares = []
            for sign in (1e-6, -1e-6):
                moved = {**start, name: start[name] + sign * direction}
                shares.append(float((bracket * denoiser.encode(render(moved))).sum()))
            expected = (shares[0] - shares[1]) / 2e-6
            assert values.grad is not None
            assert float((values.grad * direction).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-6), name


def test_the_engine_and_its_slow_twin_pass_the_same_gradient() -> None:
    gradients = []
    for backend in ("rust", "torch"):
        gaussians = {name: values.requires_grad_() for name, values in make_gaussians().items()}
        loss_of(LinearDenoiser(SIZE), render(gaussians, backend)).backward()
        gradients.append({name: values.grad for name, values in gaussians.items()})
    for name, gradient in gradients[0].items():
        assert float(gradient.abs().max()) > 0
        torch.testing.assert_close(gradient, gradients[1][name], rtol=1e-7, atol=1e-9)


def test_the_objects_field_learns_from_the_prior() -> None:
    """Every group of the field gets a gradient, and following it makes the picture the prior's."""
    torch.manual_seed(0)
    normals = fibonacci_ball(150)
    config = ObjectSplatsConfig(
        triplane=TriplaneConfig(features=4, resolution=16),
        decoders=DecoderConfig(appearance_width=16, geometry_width=16),
    )
    obj = ObjectSplats(0.05 * normals, normals, np.full((150, 3), 0.5), config)

    def picture() -> Tensor:
        canonical = obj()
        return render(
            {
                "means": canonical.means + torch.tensor([0.0, 0.0, 0.5]),
                "quats": canonical.quats,
                "scales": canonical.scales,
                "opacities": canonical.opacities,
                "colors": canonical.colors,
            }
        )

    with torch.no_grad():
        wanted = picture()
        wanted[:, 0] += 0.3 * (wanted[:, 0] < 0.9)

    class Wish(LinearDenoiser):
        """Believes in one picture: z_t is that picture's, whatever noise was added."""

        def predict(self, noisy: Tensor, timesteps: Tensor, conditions: object) -> Tensor:
            a = self.alphas_cumprod[timesteps][:, None, None, None]
            return (noisy - a.sqrt() * self.encode(wanted)) / (1 - a).sqrt()

    prior = Wish(SIZE, dtype=torch.float32)
    optimizer = torch.optim.Adam(obj.parameters(), lr=0.02)
    with torch.no_grad():
        before = float((picture() - wanted).abs().mean())
    for _ in range(40):
        optimizer.zero_grad()
        loss_of(prior, picture()).backward()
        optimizer.step()
    missing = [name for name, p in obj.named_parameters() if p.grad is None or not bool(p.grad.any())]
    assert missing == []
    with torch.no_grad():
        assert float((picture() - wanted).abs().mean()) < 0.25 * before

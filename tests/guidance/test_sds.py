"""Eq. 7: the gradient is w(t) (eps_hat - eps) at the latents, before them that times the Jacobian."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from toy_denoisers import GaussianImages, LinearDenoiser, front

from bigs.checks import InputError
from bigs.guidance import SdsConfig, classifier_free, sds_loss, timestep_range, timestep_weight
from bigs.guidance.sds import limited

SIZE = 8


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def pictures(count: int = 2, size: int = SIZE) -> Tensor:
    return torch.rand(count, 3, size, size, generator=seeded(7), dtype=torch.float64)


class Recorder(LinearDenoiser):
    """Keeps the latents with their gradient."""

    latents: Tensor

    def encode(self, images: Tensor) -> Tensor:
        self.latents = super().encode(images)
        self.latents.retain_grad()
        return self.latents


def expected_gradient(denoiser: LinearDenoiser, latents: Tensor, weights: Tensor) -> Tensor:
    """By the formula alone: eps from z_t and z, eps_hat from the network, the mean over the pictures."""
    noisy, timesteps, conditions = denoiser.asked[-1]
    a = denoiser.alphas_cumprod[timesteps][:, None, None, None]
    noise = (noisy - a.sqrt() * latents) / (1 - a).sqrt()
    estimate = LinearDenoiser.predict(denoiser, noisy, timesteps, conditions)
    return weights[:, None, None, None] * (estimate - noise) / len(latents)


@pytest.mark.parametrize(
    ("weighting", "weight"),
    [
        ("sigma2", lambda a: 1 - a),
        ("alpha_sigma2", lambda a: a**0.5 * (1 - a)),
        ("uniform", lambda a: torch.ones_like(a)),
    ],
)
def test_gradient_at_the_latents(weighting: str, weight: Callable[[Tensor], Tensor]) -> None:
    denoiser = Recorder()
    images = pictures().requires_grad_()
    loss = sds_loss(
        denoiser, images, front(2), SdsConfig(weighting=weighting), progress=0.3, generator=seeded()
    )
    loss.backward()
    weights = weight(denoiser.alphas_cumprod[denoiser.asked[-1][1]])
    expected = expected_gradient(denoiser, denoiser.latents.detach(), weights)
    torch.testing.assert_close(denoiser.latents.grad, expected, rtol=1e-12, atol=1e-12)
    assert loss.item() == pytest.approx(0.5 * expected.square().sum().item(), rel=1e-6)


def test_gradient_at_the_pictures_is_that_times_the_jacobian() -> None:
    denoiser = LinearDenoiser()
    images = pictures(1).requires_grad_()
    sds_loss(denoiser, images, front(), SdsConfig(), progress=0.0, generator=seeded()).backward()
    jacobian = torch.autograd.functional.jacobian(denoiser.encode, images.detach())
    weights = timestep_weight("sigma2", denoiser.alphas_cumprod, denoiser.asked[-1][1])
    at_latents = expected_gradient(denoiser, denoiser.encode(images.detach()), weights)
    expected = torch.einsum("bchw,bchwnijk->nijk", at_latents, jacobian)
    torch.testing.assert_close(images.grad, expected, rtol=1e-12, atol=1e-12)


def test_upstream_factor_scales_the_gradient() -> None:
    gradients = []
    for factor in (1.0, 0.25):
        images = pictures(1).requires_grad_()
        loss = sds_loss(LinearDenoiser(), images, front(), SdsConfig(), progress=0.0, generator=seeded())
        (factor * loss).backward()
        gradients.append(images.grad)
    torch.testing.assert_close(gradients[1], 0.25 * gradients[0])


def test_no_gradient_passes_through_the_network() -> None:
    class Trainable(LinearDenoiser):
        factor = torch.ones((), dtype=torch.float64, requires_grad=True)

        def predict(self, noisy: Tensor, timesteps: Tensor, conditions: object) -> Tensor:
            assert not noisy.requires_grad
            return noisy * self.factor

    denoiser = Trainable()
    images = pictures().requires_grad_()
    sds_loss(denoiser, images, front(2), SdsConfig(), progress=0.0, generator=seeded()).backward()
    assert denoiser.factor.grad is None


def test_same_generator_same_gradient_and_another_one_another() -> None:
    def gradient(seed: int) -> Tensor:
        images = pictures().requires_grad_()
        sds_loss(
            LinearDenoiser(), images, front(2), SdsConfig(), progress=0.5, generator=seeded(seed)
        ).backward()
        assert images.grad is not None
        return images.grad

    assert torch.equal(gradient(1), gradient(1))
    assert not torch.allclose(gradient(1), gradient(2))


def test_exact_denoiser_of_a_gaussian_pulls_by_the_formula() -> None:
    """The mean gradient is w sigma alpha (x - mean) / (alpha^2 spread^2 + sigma^2): towards the mean."""
    mean = torch.full((3, SIZE, SIZE), 0.3, dtype=torch.float64)
    denoiser = GaussianImages(mean, spread=0.1)
    images = (mean + 0.4).expand(64, -1, -1, -1).clone().requires_grad_()
    config = SdsConfig(t_first=(0.5, 0.5), t_last=(0.5, 0.5))
    sds_loss(denoiser, images, front(64), config, progress=0.0, generator=seeded()).backward()
    a = float(denoiser.alphas_cumprod[round(0.5 * 999)])
    expected = (1 - a) * (1 - a) ** 0.5 * a**0.5 * 0.4 / (a * 0.01 + 1 - a)
    assert images.grad is not None
    assert float(images.grad.sum(0).mean()) == pytest.approx(expected, rel=0.02)


def test_descent_ends_at_the_mode() -> None:
    mean = torch.rand(1, 3, SIZE, SIZE, generator=seeded(3), dtype=torch.float64)
    denoiser = GaussianImages(mean, spread=0.0)
    images = torch.full_like(mean, 0.5).requires_grad_()
    optimizer = torch.optim.SGD([images], lr=1.0)
    generator = seeded()
    for step in range(60):
        optimizer.zero_grad()
        sds_loss(denoiser, images, front(), SdsConfig(), progress=step / 59, generator=generator).backward()
        optimizer.step()
    assert float((images - mean).detach().abs().max()) < 1e-3


def test_masks_keep_the_rest_still() -> None:
    denoiser = Recorder()
    images = pictures(1).requires_grad_()
    masks = torch.zeros(1, 1, SIZE, SIZE)
    masks[..., : SIZE // 2] = 1.0
    masks[..., SIZE // 2 :: 2] = 0.5
    sds_loss(denoiser, images, front(), SdsConfig(), progress=0.0, generator=seeded(), masks=masks).backward()
    weights = timestep_weight("sigma2", denoiser.alphas_cumprod, denoiser.asked[-1][1])
    whole = expected_gradient(denoiser, denoiser.latents.detach(), weights)
    found = denoiser.latents.grad
    assert found is not None
    torch.testing.assert_close(found[..., :2], whole[..., :2])
    torch.testing.assert_close(found[..., 2:], 0.25 * whole[..., 2:])


def test_edges_are_detected_once_without_gradient_or_taken_as_given() -> None:
    class Edged(LinearDenoiser):
        @staticmethod
        def detect_edges(images: Tensor) -> Tensor:
            assert not images.requires_grad
            assert images.shape[-2:] == (SIZE, SIZE)
            return images.mean(1, keepdim=True)

    denoiser = Edged()
    images = pictures(2, 16).requires_grad_()
    arguments = {"progress": 0.0, "generator": seeded()}
    sds_loss(denoiser, images, front(2), SdsConfig(), **arguments)
    assert denoiser.asked[-1][2].edges.shape == (2, 1, SIZE, SIZE)
    given = front(2)._replace(edges=torch.full((2, 1, 16, 16), 0.25))
    sds_loss(denoiser, images, given, SdsConfig(), **arguments)
    assert torch.allclose(denoiser.asked[-1][2].edges, torch.tensor(0.25))
    assert denoiser.asked[-1][2].edges.shape == (2, 1, SIZE, SIZE)


def test_long_gradients_are_shortened_short_ones_kept() -> None:
    gradients = torch.tensor([[[[3.0, 4.0]]], [[[0.3, 0.4]]], [[[0.0, 0.0]]]])
    found = limited(gradients, 1.0)
    torch.testing.assert_close(found, torch.tensor([[[[0.6, 0.8]]], [[[0.3, 0.4]]], [[[0.0, 0.0]]]]))
    images = pictures(1).requires_grad_()
    denoiser = Recorder()
    sds_loss(
        denoiser, images, front(), SdsConfig(max_grad_norm=1e-3), progress=0.0, generator=seeded()
    ).backward()
    assert float(denoiser.latents.grad.norm()) == pytest.approx(1e-3)


@pytest.mark.parametrize("where", ["encode", "predict"])
def test_what_is_not_finite_shows_in_the_loss(monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    """The loop looks at the loss before it takes a step; a limit on the gradient must not hide it."""
    denoiser = LinearDenoiser()
    original = getattr(denoiser, where)

    def broken(*arguments: object) -> Tensor:
        values = original(*arguments).clone()
        values[0, 0, 0, 0] = float("inf")
        return values

    monkeypatch.setattr(denoiser, where, broken)
    config = SdsConfig(max_grad_norm=1.0)
    loss = sds_loss(denoiser, pictures(), front(2), config, progress=0.0, generator=seeded())
    assert not bool(torch.isfinite(loss))


def test_range_advances_with_progress() -> None:
    config = SdsConfig(t_first=(0.5, 0.98), t_last=(0.02, 0.3))
    ranges = [timestep_range(config, k / 10, 1001) for k in range(11)]
    assert ranges[0] == (500, 980)
    assert ranges[5] == (260, 640)
    assert ranges[-1] == (20, 300)
    assert all(a[0] > b[0] and a[1] > b[1] for a, b in itertools.pairwise(ranges))
    assert timestep_range(config, -1.0, 1001) == ranges[0]
    assert timestep_range(config, 2.0, 1001) == ranges[-1]


@pytest.mark.parametrize("progress", [0.0, 0.5, 1.0])
def test_drawn_timesteps_fill_the_range(progress: float) -> None:
    denoiser, config = LinearDenoiser(), SdsConfig(t_first=(0.5, 0.9), t_last=(0.0, 0.2))
    images = pictures(256)
    sds_loss(denoiser, images, front(256), config, progress=progress, generator=seeded())
    drawn = denoiser.asked[-1][1]
    assert (int(drawn.min()), int(drawn.max())) == timestep_range(config, progress, 100)


def test_classifier_free_guidance() -> None:
    conditional, unconditional = torch.tensor([1.0, 2.0]), torch.tensor([0.5, 4.0])
    assert torch.equal(classifier_free(conditional, unconditional, 1.0), conditional)
    assert torch.equal(classifier_free(conditional, unconditional, 0.0), unconditional)
    assert classifier_free(conditional, unconditional, 3.0).tolist() == [2.0, -2.0]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"t_first": (0.9, 0.5)}, ["t_first", "low <= high", "0.9"]),
        ({"t_last": (0.1, 1.5)}, ["t_last", "1.5"]),
        ({"weighting": "snr"}, ["weighting", "sigma2", "'snr'"]),
        ({"max_grad_norm": 0.0}, ["max_grad_norm", "more than 0"]),
    ],
)
def test_settings_that_cannot_be(settings: dict[str, object], words: list[str]) -> None:
    with pytest.raises(InputError) as refusal:
        SdsConfig(**settings)
    assert all(word in str(refusal.value) for word in words)

"""Score distillation: a picture is pulled to where a diffusion model finds it likely (paper Eq. 7).

Poole et al., "DreamFusion: text-to-3D using 2D diffusion" (2023).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from bigs.guidance.denoiser import Conditions, Denoiser
from bigs.guidance.schedule import SdsConfig, timestep_range, timestep_weight


def sds_loss(
    denoiser: Denoiser,
    images: Tensor,
    conditions: Conditions,
    config: SdsConfig,
    *,
    progress: float,
    generator: torch.Generator,
    masks: Tensor | None = None,
) -> Tensor:
    """A scalar whose gradient at the latents z is w(t) (eps_hat - eps) / B, for one draw of t and eps each.

    That is Eq. 7 without the expectation, a mean over the B pictures. It reaches the pictures through
    `denoiser.encode`, never through the denoising network. The value, half the squared length of that
    gradient, is for logs: it does not fall to zero.

    Args:
        denoiser: the prior.
        images: [B, 3, H, W] in [0, 1]; brought to the size that the prior works at.
        conditions: of each picture.
        config: timesteps, weight, limit.
        progress: share of the steps that is done, in [0, 1].
        generator: on the CPU, so that every device draws the same t and eps.
        masks: [B, 1, H, W] in [0, 1]: how much of the gradient counts at each place; all of it if not given.

    Returns:
        The loss. It is not finite if latents or estimated noise are not; such a step must not be taken.
    """
    images = resized(images, denoiser.image_size)
    if conditions.edges is not None:
        conditions = conditions._replace(edges=resized(conditions.edges, denoiser.image_size))
    elif denoiser.detect_edges is not None:
        conditions = conditions._replace(edges=denoiser.detect_edges(images.detach()))
    latents = denoiser.encode(images)
    with torch.no_grad():
        alphas_cumprod = denoiser.alphas_cumprod.to(latents)
        low, high = timestep_range(config, progress, len(alphas_cumprod))
        timesteps = torch.randint(low, high + 1, (len(latents),), generator=generator).to(latents.device)
        noise = torch.randn(latents.shape, generator=generator).to(latents)
        estimate = denoiser.predict(
            add_noise(latents, noise, timesteps, alphas_cumprod), timesteps, conditions
        )
        weight = timestep_weight(config.weighting, alphas_cumprod, timesteps)
        gradient = weight[:, None, None, None] * (estimate.to(latents) - noise)
        if masks is not None:
            height, width = latents.shape[-2:]
            gradient = gradient * torch.nn.functional.adaptive_avg_pool2d(masks.to(latents), (height, width))
        if config.max_grad_norm is not None:
            gradient = limited(gradient, config.max_grad_norm)
    loss: Tensor = _GivenGradient.apply(latents, gradient / len(latents))
    return loss.to(images.device)  # the prior may live on another device


def add_noise(latents: Tensor, noise: Tensor, timesteps: Tensor, alphas_cumprod: Tensor) -> Tensor:
    """z_t = sqrt(a_t) z + sqrt(1 - a_t) eps, for latents [B, c, h, w] and timesteps [B]."""
    alphas = alphas_cumprod[timesteps][:, None, None, None]
    return alphas.sqrt() * latents + (1.0 - alphas).sqrt() * noise


def limited(gradients: Tensor, max_norm: float) -> Tensor:
    """Each of B gradients [B, ...], shortened to `max_norm` where it is longer."""
    norms = gradients.flatten(1).norm(dim=1)
    shares = (max_norm / norms.clamp_min(torch.finfo(norms.dtype).tiny)).clamp_max(1.0)
    return gradients * shares.reshape(-1, *[1] * (gradients.ndim - 1))


class _GivenGradient(torch.autograd.Function):
    """Half the squared length of `gradient`, with exactly `gradient` as derivative by `values`.

    The usual form, (values * gradient).sum(), has a meaningless value; the other one, the squared distance
    from values - gradient, rounds the gradient.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, gradient: Tensor) -> Tensor:
        ctx.save_for_backward(gradient)
        # Non-finite values must show, even if the estimate hides them.
        return 0.5 * gradient.float().square().sum() + 0.0 * values.float().sum()

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return upstream[0].to(gradient) * gradient, None


def resized(images: Tensor, size: int) -> Tensor:
    """Pictures [B, c, H, W] with `size` rows and columns."""
    if images.shape[-2:] == (size, size):
        return images
    return torch.nn.functional.interpolate(images, (size, size), mode="bilinear", antialias=True)

"""How well a diffusion model knows pictures: how wrong it is about them when noise hides nearly all."""

from __future__ import annotations

import torch
from torch import Tensor

from bigs.guidance.denoiser import Conditions, Denoiser
from bigs.guidance.sds import add_noise, resized

# Share of the schedule at which the model is asked: nothing but edges shows there, so it has to know the
# object. Then, draws of noise per picture.
_NOISE = 0.9
_DRAWS = 4


@torch.no_grad()
def picture_residual(denoiser: Denoiser, images: Tensor, conditions: Conditions, seed: int = 0) -> float:
    """Mean squared error of the latents that a model believes in behind much noise, over B pictures.

    Of pictures as it learned from it is small; of others the model believes in something else.

    Args:
        denoiser: the model.
        images: [B, 3, H, W] in [0, 1]; brought to the size that it works at.
        conditions: of each picture; edges are detected if it needs them.
        seed: of the noise.
    """
    images = resized(images, denoiser.image_size)
    if conditions.edges is None and denoiser.detect_edges is not None:
        conditions = conditions._replace(edges=denoiser.detect_edges(images))
    latents = denoiser.encode(images)
    alphas_cumprod = denoiser.alphas_cumprod.to(latents)
    timestep = round(_NOISE * (len(alphas_cumprod) - 1))
    timesteps = torch.full((len(latents),), timestep, device=latents.device)
    # z = (z_t - sqrt(1 - a) eps) / sqrt(a), so an error of the noise is a larger error of the latents.
    larger = (1.0 - alphas_cumprod[timestep]) / alphas_cumprod[timestep]
    generator = torch.Generator().manual_seed(seed)
    errors = []
    for _ in range(_DRAWS):
        noise = torch.randn(latents.shape, generator=generator).to(latents)
        noisy = add_noise(latents, noise, timesteps, alphas_cumprod)
        estimate = denoiser.predict(noisy, timesteps, conditions).to(latents)
        errors.append(larger * (estimate - noise).square().mean())
    return float(torch.stack(errors).mean())

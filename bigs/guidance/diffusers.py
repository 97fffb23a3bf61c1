"""Stable Diffusion as a prior: latents, text, soft edges through a ControlNet (paper Eq. 7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from bigs.checks import InputError
from bigs.guidance.denoiser import Conditions, EdgeDetector, classifier_free
from bigs.guidance.diffusers_folder import Device, Parts, Precision, load_parts
from bigs.guidance.edges import soft_edges
from bigs.guidance.fingerprint import fingerprint
from bigs.guidance.pidinet import PiDiNet, load_pidinet
from bigs.guidance.prompts import PromptConfig, view_indices, view_prompts
from bigs.guidance.token_file import Token, add_token, read_token


@dataclass(frozen=True)
class DiffusionConfig:
    """Which Stable Diffusion, and its settings. The two scales are those of the paper's released code."""

    model: str  # folder as diffusers saves it, or a name on the Hugging Face hub
    controlnet: str | None = None  # likewise; a soft-edge ControlNet
    edge_weights: Path | None = None  # PiDiNet's published file; `soft_edges` without it
    token: Path | None = None  # learned word for the object
    prompts: PromptConfig = field(default_factory=PromptConfig)
    guidance_scale: float = 50.0  # guidance scale, relative to the unconditional estimate
    conditioning_scale: float = 0.3  # weight of the ControlNet
    device: Device = "auto"
    precision: Precision = "auto"
    attention_slicing: bool = False

    def __post_init__(self) -> None:
        if self.edge_weights is not None and self.controlnet is None:
            raise InputError("edge_weights: expected a controlnet that looks at edges, found none")
        if not self.conditioning_scale >= 0.0:
            raise InputError(f"conditioning_scale: expected 0 or more, found {self.conditioning_scale}")


class StableDiffusion:
    """A `Denoiser` over a latent diffusion model, with prompts by view and edges through a ControlNet."""

    def __init__(
        self,
        parts: Parts,
        prompts: PromptConfig,
        *,
        token: Token | None = None,
        guidance_scale: float = 50.0,
        conditioning_scale: float = 0.3,
        edges: EdgeDetector = soft_edges,
    ) -> None:
        """
        Args:
            parts: the networks.
            prompts: the words.
            token: a learned word; the ControlNet does not know it and is given the prompts without it.
            guidance_scale: see `classifier_free`.
            conditioning_scale: weight of what the ControlNet adds.
            edges: makes the ControlNet's picture; not used without a ControlNet.

        Raises:
            InputError: a prompt is too long for the text encoder, or the token does not fit the model.
        """
        self._parts = parts
        self._guidance_scale, self._conditioning_scale = guidance_scale, conditioning_scale
        self._edges: EdgeDetector | None = None
        if parts.controlnet is not None:
            self._edges = lambda images: edges(images.to(parts.device))
        self._settings = (
            *(prompts, dict(parts.scheduler.config), guidance_scale, conditioning_scale),
            *(() if token is None else (token.name, token.embedding.double().tolist())),
        )
        weights = [network.state_dict() for network in parts.networks]
        weights += [edges.weights] if isinstance(edges, PiDiNet) else []
        self._weights = {
            f"{i}.{name}": value for i, part in enumerate(weights) for name, value in part.items()
        }
        with torch.no_grad():
            word = None if token is None else add_token(parts, token)
            self._texts = encode_text(parts, view_prompts(prompts, word))
            self._control_texts = encode_text(parts, view_prompts(prompts))
            self._negative = encode_text(parts, [prompts.negative])

    @property
    def alphas_cumprod(self) -> Tensor:
        """[T] of the model's own scheduler."""
        alphas: Tensor = self._parts.scheduler.alphas_cumprod
        return alphas

    @property
    def image_size(self) -> int:
        """Rows and columns of the pictures that the VAE takes."""
        return self._parts.image_size

    @property
    def detect_edges(self) -> EdgeDetector | None:
        """The ControlNet's; None without one."""
        return self._edges

    @property
    def familiar(self) -> float | None:
        """None, since its training data are unknown."""
        return None

    @property
    def fingerprint(self) -> str:
        """See `Denoiser`."""
        return fingerprint(self._weights, self._settings)

    def encode(self, images: Tensor) -> Tensor:
        """The mean [B, c, h, w] of the VAE's distribution, scaled as the model expects its latents."""
        return encode_images(self._parts, images)

    def predict(self, noisy: Tensor, timesteps: Tensor, conditions: Conditions) -> Tensor:
        """The noise [B, c, h, w], `classifier_free` between the view's prompt and the negative one.

        Raises:
            InputError: there is a ControlNet, and `conditions` has no edges.
        """
        device, dtype = self._parts.unet.device, self._parts.unet.dtype
        views = view_indices(conditions.azimuths, conditions.elevations).to(device)
        negative = self._negative.expand(len(noisy), -1, -1)
        twice = torch.cat([noisy, noisy]), torch.cat([timesteps, timesteps])
        control = None
        if self._parts.controlnet is not None:
            if conditions.edges is None:
                raise InputError("conditions: expected edges for the ControlNet, found none")
            edges = conditions.edges.to(device, dtype).repeat(2, 1, 1, 1)
            control = torch.cat([negative, self._control_texts[views]]), edges, self._conditioning_scale
        noise = predict_noise(
            self._parts, *twice, texts=torch.cat([negative, self._texts[views]]), control=control
        )
        unconditional, conditional = noise.chunk(2)
        return classifier_free(conditional, unconditional, self._guidance_scale)


def load_stable_diffusion(config: DiffusionConfig) -> StableDiffusion:
    """The prior that a configuration names, ready for `sds_loss`.

    Raises:
        InputError: one sentence: which component is missing or does not fit, which file cannot be read.
    """
    token = None if config.token is None else read_token(config.token)
    edges = edge_detector(config.edge_weights)
    parts = load_parts(
        config.model,
        controlnet=config.controlnet,
        device=config.device,
        precision=config.precision,
        attention_slicing=config.attention_slicing,
    )
    return StableDiffusion(
        parts,
        config.prompts,
        token=token,
        guidance_scale=config.guidance_scale,
        conditioning_scale=config.conditioning_scale,
        edges=edges,
    )


def edge_detector(weights: Path | None) -> EdgeDetector:
    """PiDiNet from a file, or the built-in filter without one.

    Raises:
        InputError: the file is not PiDiNet.
    """
    return soft_edges if weights is None else load_pidinet(weights)


def encode_text(parts: Parts, prompts: Sequence[str]) -> Tensor:
    """The text embeddings [P, L, width] of P prompts padded to L words.

    Raises:
        InputError: a prompt has more words than the text encoder takes.
    """
    limit = parts.tokenizer.model_max_length
    for prompt in prompts:
        if (count := len(parts.tokenizer(prompt).input_ids)) > limit:
            raise InputError(f"prompt: expected at most {limit} words or parts of words, found {count}")
    words = parts.tokenizer(list(prompts), padding="max_length", max_length=limit, return_tensors="pt")
    texts: Tensor = parts.text_encoder(words.input_ids.to(parts.device))[0]
    return texts


def encode_images(parts: Parts, images: Tensor) -> Tensor:
    """Latents [B, c, h, w] of pictures [B, 3, H, W] in [0, 1]; differentiable, nothing is drawn."""
    values = 2.0 * images.to(parts.device, parts.vae.dtype) - 1.0
    latents: Tensor = parts.vae.encode(values).latent_dist.mode() * parts.vae.config.scaling_factor
    return latents


def predict_noise(
    parts: Parts,
    noisy: Tensor,
    timesteps: Tensor,
    *,
    texts: Tensor,
    control: tuple[Tensor, Tensor, float] | None = None,
) -> Tensor:
    """The noise in z_t [B, c, h, w], whatever the network was trained to predict; without guidance.

    With z_t = alpha z + sigma eps, a network predicts eps itself, the velocity alpha eps - sigma z
    (Salimans and Ho, "Progressive distillation for fast sampling of diffusion models", 2022), or z.

    Args:
        parts: the networks.
        noisy: z_t.
        timesteps: [B].
        texts: [B, L, width].
        control: for the ControlNet: its texts [B, L, width], edges [B, 1, H, W], and its weight.

    Returns:
        In the precision of `noisy`.
    """
    unet, timesteps = parts.unet, timesteps.to(parts.device)
    inputs = noisy.to(parts.device, unet.dtype)
    added = {}
    if control is not None:
        control_texts, edges, scale = control
        channels = parts.controlnet.config.conditioning_channels
        down, middle = parts.controlnet(
            inputs,
            timesteps,
            encoder_hidden_states=control_texts,
            controlnet_cond=edges.expand(-1, channels, -1, -1),
            conditioning_scale=scale,
            return_dict=False,
        )
        added = {"down_block_additional_residuals": down, "mid_block_additional_residual": middle}
    predicted = unet(inputs, timesteps, encoder_hidden_states=texts, return_dict=False, **added)[0].to(noisy)
    kind = parts.scheduler.config.prediction_type
    if kind == "epsilon":
        noise: Tensor = predicted
        return noise
    a = parts.scheduler.alphas_cumprod.to(noisy)[timesteps.to(noisy.device)][:, None, None, None]
    alpha, sigma = a.sqrt(), (1.0 - a).sqrt()
    return (
        alpha * predicted + sigma * noisy if kind == "v_prediction" else (noisy - alpha * predicted) / sigma
    )

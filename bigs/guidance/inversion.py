"""Textual inversion: a word that stands for one object, learned from pictures of it.

Gal et al., "An image is worth one word: personalizing text-to-image generation using textual inversion"
(2023); the paper's section on the object loss. Only the word's own embedding is trained.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from bigs.checks import InputError
from bigs.guidance.crops import Crop, draw_pictures
from bigs.guidance.denoiser import EdgeDetector
from bigs.guidance.diffusers import encode_images, encode_text, predict_noise
from bigs.guidance.diffusers_folder import Parts
from bigs.guidance.sds import add_noise
from bigs.guidance.token_file import Token, new_words

# Several sentences, so that the word comes to mean the object and not the sentence.
TEMPLATES = (
    "a photo of a {}",
    "a close-up photo of a {}",
    "a {} on a white background",
    "a picture that shows one {}",
    "a rendering of a {}",
)
# float16 loses gradients below 6e-8, so the loss is scaled by this much and its gradient scaled back.
_FLOAT16_SCALE = 1024.0


@dataclass(frozen=True)
class InversionConfig:
    """How a word is learned."""

    object_name: str
    token: str = "<bigs-object>"
    steps: int = 1000
    batch: int = 2  # pictures in a step
    lr: float = 5e-3
    conditioning_scale: float = 0.8  # weight of the ControlNet, if there is one
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.object_name.strip():
            raise InputError("object name: expected at least one word, found none")
        if not self.token or self.token.split() != [self.token]:
            raise InputError(f"token: expected one word without spaces, found {self.token!r}")
        for name in ("steps", "batch"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected at least 1, found {getattr(self, name)}")
        if not self.conditioning_scale >= 0.0:
            raise InputError(f"conditioning_scale: expected 0 or more, found {self.conditioning_scale}")
        if not self.lr > 0.0:
            raise InputError(f"lr: expected more than 0, found {self.lr}")


class Inversion:
    """The word while it is learned: its embedding, the optimiser's moments, and the steps done.

    The text encoder's table is not touched: where a prompt has the word, the table's answer is replaced.
    """

    def __init__(self, parts: Parts, config: InversionConfig) -> None:
        """
        Raises:
            InputError: the tokenizer knows the token already.
        """
        self._parts, self._config = parts, config
        # The text encoder is small, and the word's gradient passes through all of it.
        parts.text_encoder.float()
        parts.unet.enable_gradient_checkpointing()
        table = parts.text_encoder.get_input_embeddings()
        known = parts.tokenizer(config.object_name, add_special_tokens=False).input_ids
        start = table.weight[known].mean(0, keepdim=True)
        (self._row,) = new_words(parts, [config.token])
        self.embedding = start.detach().clone().requires_grad_()  # [1, width]
        self._optimizer = torch.optim.Adam([self.embedding], lr=config.lr)
        self.step = 0
        parts.text_encoder.get_input_embeddings().register_forward_hook(self._replace)

    def _replace(self, _module: Any, words: tuple[Tensor, ...], embedded: Tensor) -> Tensor:
        return torch.where((words[0] == self._row)[..., None], self.embedding.to(embedded), embedded)

    @property
    def token(self) -> Token:
        """The word as it is now."""
        return Token(self._config.token, self.embedding.detach().clone())

    def state(self) -> dict[str, Tensor]:
        """Everything that another `Inversion` needs to go on from here, save the number of steps."""
        moments = self._optimizer.state_dict()["state"].get(0, {})
        return {"embedding": self.embedding.detach().cpu(), **{k: v.cpu() for k, v in moments.items()}}

    def restore(self, state: dict[str, Tensor], step: int) -> None:
        """Go on from `state`, as after `step` steps."""
        moments = {name: value for name, value in state.items() if name != "embedding"}
        with torch.no_grad():
            self.embedding.copy_(state["embedding"])
        saved = self._optimizer.state_dict()
        self._optimizer.load_state_dict(saved | {"state": {0: moments} if moments else {}})
        self.step = step

    def loss(self, crops: list[Crop], edges: EdgeDetector, generator: torch.Generator) -> Tensor:
        """Mean squared error of the estimated noise where the object is, for one draw of everything.

        Places that are not object do not count: what hands hide, and the white that replaces the background,
        are nothing to learn.
        """
        parts, config = self._parts, self._config
        pictures, shares = draw_pictures(crops, config.batch, parts.image_size, generator)
        template = TEMPLATES[int(torch.randint(len(TEMPLATES), (), generator=generator))]
        pictures, shares = pictures.to(parts.device), shares.to(parts.device)
        with torch.no_grad():
            latents = encode_images(parts, pictures)
            noise = torch.randn(latents.shape, generator=generator).to(latents)
            alphas = parts.scheduler.alphas_cumprod.to(latents)
            timesteps = torch.randint(len(alphas), (config.batch,), generator=generator).to(latents.device)
            noisy = add_noise(latents, noise, timesteps, alphas)
            control = None
            if parts.controlnet is not None:
                # The ControlNet gets the plain name, as when the prior is used.
                texts = self._texts(template.format(config.object_name))
                control = texts, edges(pictures).to(texts), config.conditioning_scale
        texts = self._texts(template.format(f"{config.token} {config.object_name}"))
        estimate = predict_noise(parts, noisy, timesteps, texts=texts, control=control)
        height, width = latents.shape[-2:]
        weights = torch.nn.functional.adaptive_avg_pool2d(shares, (height, width)).to(latents)
        squares = (estimate - noise).square().mean(1, keepdim=True)
        return (weights * squares).sum() / weights.sum().clamp_min(1e-6)

    def _texts(self, prompt: str) -> Tensor:
        return encode_text(self._parts, [prompt] * self._config.batch).to(self._parts.unet.dtype)

    def take_step(self, crops: list[Crop], edges: EdgeDetector) -> float:
        """One step of Adam; what is drawn is a function of seed and step. Returns the loss.

        Raises:
            FloatingPointError: the gradient is not finite; the step is not taken.
        """
        generator = torch.Generator().manual_seed(self._config.seed * 1_000_003 + self.step)
        loss = self.loss(crops, edges, generator)
        scale = _FLOAT16_SCALE if self._parts.unet.dtype == torch.float16 else 1.0
        self._optimizer.zero_grad()
        (scale * loss).backward()
        gradient = self.embedding.grad
        if gradient is None or not bool(torch.isfinite(gradient).all()):
            raise FloatingPointError(
                f"step {self.step}: the gradient of {self._config.token} is not finite; try another precision"
            )
        gradient /= scale
        self._optimizer.step()
        self.step += 1
        return float(loss.detach())

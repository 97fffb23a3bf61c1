"""The interface of a diffusion model as a prior, for latent and pixel-space models."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from torch import Tensor

# Pictures [B, 3, H, W] in [0, 1] to edges [B, 1, H, W] in [0, 1].
EdgeDetector = Callable[[Tensor], Tensor]


class Conditions(NamedTuple):
    """The conditions of B pictures. Prompts are the adapter's own, chosen by the view.

    Azimuth 0 is the front, the side of the object that the caller calls so; seen from above it grows
    anticlockwise. Elevation 0 is level, pi / 2 looks straight down on the object.
    """

    azimuths: Tensor  # [B] radians
    elevations: Tensor  # [B] radians
    edges: Tensor | None = (
        None  # [B, 1, H, W] in [0, 1], 1 on an edge; None: `sds_loss` detects them if needed
    )


class Denoiser(Protocol):
    """A trained diffusion model with its noise schedule.

    `z_t = sqrt(a_t) z + sqrt(1 - a_t) eps`, where a_t is `alphas_cumprod[t]` and z what `encode` returns.
    """

    @property
    def alphas_cumprod(self) -> Tensor:
        """[T], falling with the timestep."""
        ...

    @property
    def image_size(self) -> int:
        """Rows and columns of the pictures that `encode` takes."""
        ...

    @property
    def detect_edges(self) -> EdgeDetector | None:
        """How to make the edges that `predict` needs; None for a model that is not conditioned on edges."""
        ...

    @property
    def fingerprint(self) -> str:
        """Changes with weights and whatever else estimates depend on, not with where they lie."""
        ...

    @property
    def familiar(self) -> float | None:
        """What `residual.picture_residual` is of objects that it learned from; None if that is not known."""
        ...

    def encode(self, images: Tensor) -> Tensor:
        """Pictures [B, 3, image_size, image_size] in [0, 1] to latents [B, c, h, w]; differentiable.

        The same pictures give the same latents: nothing is drawn. The latents are where noise is added.
        """
        ...

    def predict(self, noisy: Tensor, timesteps: Tensor, conditions: Conditions) -> Tensor:
        """The noise in z_t, with guidance already applied (see `classifier_free`). No gradient is asked for.

        Args:
            noisy: z_t [B, c, h, w].
            timesteps: [B] integers in [0, T).
            conditions: of each picture; `edges` are there unless `detect_edges` is None.
        """
        ...


def classifier_free(conditional: Tensor, unconditional: Tensor, scale: float) -> Tensor:
    """Estimates [B, c, h, w] mixed: `unconditional + scale (conditional - unconditional)`.

    Ho and Salimans, "Classifier-free diffusion guidance" (2022), in the form in which scale 1 is the
    conditional estimate and 0 the unconditional one.
    """
    return unconditional + scale * (conditional - unconditional)

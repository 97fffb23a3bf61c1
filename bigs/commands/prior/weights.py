"""The prior of a run: which kind its options mean, and the model behind it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from bigs.checks import InputError
from bigs.guidance.denoiser import Denoiser
from bigs.guidance.pixel_file import load_pixel_denoiser
from bigs.train.plan.config import PriorConfig, PriorKind, RunConfig


def with_prior(config: RunConfig, kind: str, object_name: str, given: Mapping[str, str]) -> RunConfig:
    """The configuration with the prior that a user asks for.

    Args:
        config: any plan.
        kind: a `PriorKind`, or "auto": what the weights are for, or the plan's own kind without any.
        object_name: for Stable Diffusion.
        given: `PriorConfig`'s paths by name; "" for what was not given.

    Raises:
        InputError: a kind that needs weights without any, or weights with a kind that has none.
    """
    prior = config.prior
    paths = {name: path for name, path in given.items() if path}
    if kind == "auto" and "weights" in paths:
        kind = "trained" if Path(paths["weights"]).suffix == ".safetensors" else "sd"
    chosen: PriorKind = prior.kind if kind == "auto" else kind  # type: ignore[assignment]
    named = {"object_name": object_name} if object_name != "object" else {}
    changed: dict[str, Any] = {"kind": chosen, **paths, **named}
    prior = replace(prior, **changed)
    allowed = {"sd": set(given), "trained": {"weights"}}.get(chosen, set())
    for name in paths:
        if name not in allowed:
            option = "--prior-" + name.replace("_", "-")
            raise InputError(f"{option}: expected a prior that uses it, found --prior {chosen}")
    _check(prior)
    return replace(config, prior=prior)


def _check(prior: PriorConfig) -> None:
    if prior.kind in ("trained", "sd") and not prior.weights:
        what = "a file of bigs prior train" if prior.kind == "trained" else "a Stable Diffusion folder"
        raise InputError(f"--prior {prior.kind}: expected --prior-weights with {what}, found none")


def load_prior(prior: PriorConfig) -> Denoiser | None:
    """The denoiser that a configuration names; None when it names none.

    Raises:
        InputError: one sentence: which file or component is missing or does not fit.
    """
    _check(prior)
    if prior.kind == "trained":
        return load_pixel_denoiser(Path(prior.weights))
    if prior.kind == "sd":
        from bigs.guidance.diffusers import DiffusionConfig, load_stable_diffusion
        from bigs.guidance.prompts import PromptConfig

        return load_stable_diffusion(
            DiffusionConfig(
                prior.weights,
                controlnet=prior.controlnet or None,
                edge_weights=Path(prior.edge_weights) if prior.edge_weights else None,
                token=Path(prior.token) if prior.token else None,
                prompts=PromptConfig(prior.object_name),
            )
        )
    return None

"""Prompts for a text-to-image model, depending on the view."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bigs.checks import InputError

VIEWS = ("front", "side", "back", "overhead", "bottom")
_FRONT, _SIDE, _BACK, _OVERHEAD, _BOTTOM = range(len(VIEWS))
# A view is the front within this azimuth of 0, the back within this of the opposite side, and neither beyond
# this elevation.
_HALF_FRONT, _STEEP = math.radians(45.0), math.radians(60.0)


@dataclass(frozen=True)
class PromptConfig:
    """The words. `{object}` stands for the object's name, after a learned token if there is one."""

    object_name: str = "object"
    prompt: str = "a photo of a {object}, high quality, realistic"
    negative: str = "blurry, distorted, deformed, low quality, text, watermark, hand, fingers"
    view_dependent: bool = True  # whether to name the view

    def __post_init__(self) -> None:
        if "{object}" not in self.prompt:
            raise InputError(f"prompt: expected a text with {{object}} in it, found {self.prompt!r}")
        if not self.object_name.strip():
            raise InputError("object name: expected at least one word, found none")


def view_indices(azimuths: Tensor, elevations: Tensor) -> Tensor:
    """Which of `VIEWS` each picture shows, [B], from angles [B] in radians as in `Conditions`."""
    turned = torch.remainder(azimuths + math.pi, 2.0 * math.pi) - math.pi
    views = torch.full_like(azimuths, _SIDE, dtype=torch.long)
    views[turned.abs() <= _HALF_FRONT] = _FRONT
    views[turned.abs() >= math.pi - _HALF_FRONT] = _BACK
    views[elevations >= _STEEP] = _OVERHEAD
    views[elevations <= -_STEEP] = _BOTTOM
    return views


def view_prompts(config: PromptConfig, token: str | None = None) -> tuple[str, ...]:
    """The prompt of each of `VIEWS`; with a token the object is called "TOKEN NAME"."""
    name = config.object_name if token is None else f"{token} {config.object_name}"
    prompt = config.prompt.replace("{object}", name)
    return tuple(f"{prompt}, {view} view" if config.view_dependent else prompt for view in VIEWS)

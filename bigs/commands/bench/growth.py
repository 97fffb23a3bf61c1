"""How the cost of a run grows: a few steps of every stage on more frames, Gaussians and pixels."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import torch

from bigs.data.base import Clip
from bigs.data.excerpt import excerpt, to_and_fro
from bigs.hand import HandModel
from bigs.train.fit import fit
from bigs.train.loop.targets import crop_box
from bigs.train.plan.config import OptimizeStage, RunConfig
from bigs.train.plan.length import planned_steps
from bigs.train.resolve import resolve
from bigs.types import Side

# Factors on the number of Gaussians: one subdivision of the hand's mesh multiplies them by four.
_FACTORS_GAUSSIANS = {"1/4": -1, "1": 0, "4": 1}
_FACTORS_SIZE = {"1/2": 0.5, "1": 1.0, "2": 2.0}


class Probe(NamedTuple):
    """One point: a plan on some frames of a clip."""

    axis: str  # what grows
    value: str
    frames: int
    config: RunConfig


def probes(clip: Clip, config: RunConfig, frames: Iterable[int]) -> list[Probe]:
    """All points: numbers of frames, and around the clip as it is Gaussians and image size."""
    found = [Probe("frames", str(count), count, config) for count in frames]
    for label, more in _FACTORS_GAUSSIANS.items():
        hand = replace(config.hand, subdivisions=max(0, config.hand.subdivisions + more))
        obj = replace(config.object, n_gaussians=round(config.object.n_gaussians * 4.0**more))
        found.append(Probe("Gaussians", label, len(clip), replace(config, hand=hand, object=obj)))
    long_side = max(clip.width, clip.height)
    for label, factor in _FACTORS_SIZE.items():
        # Images are never enlarged.
        stages = tuple(
            replace(stage, image_size=min(long_side, round(factor * (stage.image_size or long_side))))
            if isinstance(stage, OptimizeStage)
            else stage
            for stage in config.stages
        )
        found.append(Probe("image size", label, len(clip), replace(config, stages=stages)))
    return found


def measure(clip: Clip, hand_models: Mapping[Side, HandModel], probe: Probe, steps: int) -> dict[str, Any]:
    """Run `steps` steps of every stage.

    Returns:
        Seconds before the first stage ("start"), median milliseconds of a step by stage ("stages"), seconds
        of the other stages ("searches"), the whole plan's seconds as these give it ("total"), and what there
        was: "frames", "gaussians" and "pixels" of the finest stage.
    """
    clip = excerpt(clip, to_and_fro(len(clip), probe.frames))
    config = resolve(probe.config).config
    planned = planned_steps(config)
    short = replace(
        config,
        stages=tuple(
            replace(stage, steps=min(stage.steps, steps)) if isinstance(stage, OptimizeStage) else stage
            for stage in config.stages
        ),
    )
    seconds: dict[str, list[float]] = {}

    def listen(event: dict[str, Any]) -> None:
        if event["event"] == "step":
            seconds.setdefault(event["stage"], []).append(event["seconds"])

    scene, report = fit(clip, hand_models, short, listen=listen)
    # The first step of a stage fills caches.
    medians = {name: statistics.median(values[1:] or values) for name, values in seconds.items()}
    searches = {
        name: value
        for name, value in report.seconds.items()
        if name not in planned and name != "start values"
    }
    start = report.seconds["start values"]
    with torch.no_grad():
        gaussians = sum(len(subject.opacities) for subject in scene.canonical(scene.entities).values())
    return {
        "start": start,
        "stages": {name: 1e3 * value for name, value in medians.items()},
        "searches": searches,
        "total": start + sum(searches.values()) + sum(planned[name] * medians[name] for name in medians),
        "frames": len(clip),
        "gaussians": gaussians,
        "pixels": _finest_pixels(clip, probe.config),
    }


def _finest_pixels(clip: Clip, config: RunConfig) -> int:
    """Pixels of one image, inside the box that is rendered, in the stage that has the most."""
    long_side = max(clip.width, clip.height)
    sizes = [
        min(long_side, stage.image_size or long_side)
        for stage in config.stages
        if isinstance(stage, OptimizeStage)
    ]
    x0, y0, x1, y1 = crop_box(clip)
    return round((x1 - x0) * (y1 - y0) * (max(sizes) / long_side) ** 2)

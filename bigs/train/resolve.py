"""What of a plan can run with the networks that its configuration names: settled before anything is saved."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from bigs.train.plan.config import CompletionStage, GuidanceStage, OptimizeStage, RunConfig, Stage
from bigs.train.switches import without


class Resolved(NamedTuple):
    """A configuration as it runs, and what to tell of the way there."""

    config: RunConfig
    perceptual: str | None  # what became of the term "perceptual", if there is something to tell
    prior: str | None  # what became of the prior

    @property
    def notes(self) -> list[str]:
        """What to tell, a line each."""
        return [note for note in (self.perceptual, self.prior) if note]


def resolve(config: RunConfig, has_object: bool = True) -> Resolved:
    """Leave out the term "perceptual" without its network, and what asks a prior without its weights.

    What is resolved stays as it is when it is resolved again.

    Args:
        config: any plan.
        has_object: whether the clip has an object; without one no prior is needed.
    """
    config, perceptual = _with_network(config)
    config, prior = _with_prior(config)
    return Resolved(config, perceptual, prior if has_object else None)


def _with_network(config: RunConfig) -> tuple[RunConfig, str | None]:
    asking = [
        stage.name
        for stage in config.stages
        if isinstance(stage, OptimizeStage) and "perceptual" in stage.weights
    ]
    if config.perceptual_weights:
        unused = "a network was given, but no stage has the term (--set stages.NAME.weights.perceptual=1)"
        return config, None if asking else f"perceptual: {unused}"
    if not asking:
        return config, None
    return without(config, "perceptual"), (
        f"perceptual: off in {', '.join(asking)}; --perceptual-weights FILE with VGG-16 turns it on"
    )


def _with_prior(config: RunConfig) -> tuple[RunConfig, str | None]:
    if config.prior.kind == "off":
        config = _leave_out(config, CompletionStage)
    if config.prior.weights:
        unused = "prior: weights were given, but no stage of this plan uses them"
        return config, None if any(map(asks_prior, config.stages)) else unused
    distilled = any(asks_prior(stage) and isinstance(stage, OptimizeStage) for stage in config.stages)
    if distilled:
        config = without(config, "sds")
    wanted = distilled or config.prior.kind != "off"
    note = (
        "prior: no diffusion; --prior-weights turns it on, with a FILE of bigs prior train "
        "or a FOLDER of Stable Diffusion"
    )
    return _leave_out(config, GuidanceStage), note if wanted else None


def asks_prior(stage: Stage) -> bool:
    """Whether a stage needs a diffusion model."""
    return isinstance(stage, GuidanceStage) or (isinstance(stage, OptimizeStage) and "sds" in stage.weights)


def _leave_out(config: RunConfig, kind: type) -> RunConfig:
    return replace(config, stages=tuple(stage for stage in config.stages if not isinstance(stage, kind)))

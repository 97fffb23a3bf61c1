"""The stages that complete the object where no frame shows it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from bigs.geometry.symmetry import Symmetry
from bigs.guidance.denoiser import Denoiser
from bigs.models.scene import Scene
from bigs.train.loop.evidence import EvidenceSource
from bigs.train.loop.run_stage import StageState
from bigs.train.plan.config import CompletionStage, GuidanceStage, OptimizeStage, RunConfig
from bigs.train.unseen.prior_stage import guide_scene
from bigs.train.unseen.symmetry_stage import StageOutcome, complete_scene

# Image size at which errors of the seen part are measured.
OBSERVED_AT = OptimizeStage("observed", "single-subject", 0, {}, {}, image_size=240)


def run_completion(
    scene: Scene,
    stage: CompletionStage,
    sources: EvidenceSource,
    config: RunConfig,
    earlier: Sequence[Symmetry],
) -> StageOutcome:
    """Complete the object by its symmetries; see `complete_scene`."""
    return complete_scene(
        scene,
        sources.clip,
        sources.unknown,
        sources.evidence(OBSERVED_AT),
        stage,
        config.initial,
        config.prior.completion,
        config.object,
        earlier,
    )


def run_guidance(
    scene: Scene,
    stage: GuidanceStage,
    index: int,
    sources: EvidenceSource,
    config: RunConfig,
    denoiser: Denoiser,
    resume: dict[str, Any] | None,
    keep: Callable[[int, StageState | None], None],
    listen: Callable[[dict[str, Any]], None],
) -> StageOutcome:
    """Let a diffusion prior complete the object; see `guide_scene`. Its state is kept as of any stage."""

    def after_step(state: StageState, loss: float) -> None:
        progress = {"step": state.step, "steps": stage.steps, "loss": loss, "terms": {}, "seconds": 0.0}
        listen({"event": "step", "stage": stage.name, "index": index, **progress})
        if state.step % config.checkpoint_every == 0 and state.step < stage.steps:
            keep(index, state)

    evidence = sources.evidence(OBSERVED_AT)
    return guide_scene(scene, evidence, denoiser, stage, config.seed + 1000 * index, resume, after_step)

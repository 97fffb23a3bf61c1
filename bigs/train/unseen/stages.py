"""The stages that complete the object where no frame shows it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from bigs.geometry.symmetry import Symmetry
from bigs.guidance.denoiser import Denoiser
from bigs.models.occlusion import measure_occlusion
from bigs.models.scene import Scene
from bigs.train.loop.evidence import EvidenceSource
from bigs.train.loop.run_stage import StageState
from bigs.train.plan.config import CompletionStage, GuidanceStage, OptimizeStage, RunConfig
from bigs.train.start.build import SceneStart
from bigs.train.unseen.learned_surface import learned_surface
from bigs.train.unseen.openings import openings, without_openings
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
    done = complete_scene(
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
    if done.skipped is None and scene.lighting is not None and scene.lighting.measured:
        # For the surface as it is now, and for the Gaussians there. What stays as it is keeps the occlusion
        # that its colours were learned with.
        measure_occlusion(scene)
    return done


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


def finish_mesh(
    scene: Scene, start: SceneStart, sources: EvidenceSource, config: RunConfig, completed: bool
) -> dict[str, str]:
    """The object's mesh, with what was learned and without what nothing supports; returns facts to report.

    What is seen through is left out, too.

    `completed` says that symmetry completed it, which supports all of it.
    """
    facts: dict[str, str] = {}
    surface = scene.object_surface
    if surface is None or scene.object_splats is None:
        return facts
    with torch.no_grad():
        learned = learned_surface(surface, scene.object_splats())
    if start.known and not completed:
        surface, learned = start.known.of(surface), start.known.of(learned)
        facts["object mesh"] = (
            f"open: {start.known.left_out:.0%} of it would be further than "
            f"{1e3 * config.initial.surface_kept:.0f} mm from anything seen"
        )
    if config.openings is not None:
        # Of the start's surface, which the measured points helped to make.
        found = openings(scene, surface, sources.evidence(OBSERVED_AT), start.measured, config.openings)
        if found.any():
            learned = without_openings(learned, found)
            facts["object openings"] = (
                f"{found.mean():.0%} of the mesh, where hands are or hands or points are seen through it"
            )
    scene.replace_surface(learned)
    return facts

"""One stage of optimisation: the same loop for every stage, which is told apart by data only."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bigs.checks import InputError
from bigs.losses.weighted import weighted_sum
from bigs.models.scene import Scene
from bigs.train.config import OptimizeStage
from bigs.train.optim import FIELD_GROUPS, make_optimizer, set_cosine_rates
from bigs.train.terms import IMAGE_TERMS, TERMS, Evidence, Step
from bigs.types import Entity


class StageProgress(NamedTuple):
    """What a hook sees after every step."""

    step: int  # steps done
    steps: int  # steps planned
    terms: dict[str, float]
    loss: float
    seconds: float  # of this step


class StageState(NamedTuple):
    """What has to be kept to continue a stage exactly: steps done, and the optimiser with its moments."""

    step: int
    optimizer: torch.optim.Optimizer
    best: float  # smoothed loss that the stopping rule compares with
    best_step: int
    smoothed: float


def stage_entities(scene: Scene, stage: OptimizeStage) -> tuple[Entity, ...]:
    """The subjects a stage renders: all together, or alone those of which something may move."""
    if stage.step == "interacting-subjects":
        return scene.entities
    subjects = {group.split(".")[0] for group in stage.lrs}
    return tuple(
        entity for entity in scene.entities if ("object" if entity == "object" else "hand") in subjects
    )


def choose_frames(n_frames: int, stage: OptimizeStage, seed: int, step: int) -> Tensor:
    """The frames of one step, a function of the seed and the step alone, so that a resumed run repeats them.

    Every pass over the clip visits each frame once in a shuffled order.
    """
    count = stage.frames_per_step
    if count <= 0 or count >= n_frames:
        return torch.arange(n_frames)
    per_pass = -(-n_frames // count)
    generator = torch.Generator().manual_seed(seed * 1_000_003 + step // per_pass)
    order = torch.randperm(n_frames, generator=generator)
    # The last batch of a pass is filled up from the pass's beginning.
    start = (step % per_pass) * count
    return torch.cat([order, order])[start : start + count].sort().values


def run_stage(
    scene: Scene,
    stage: OptimizeStage,
    evidence: Evidence,
    seed: int,
    resume: dict[str, Any] | None = None,
    after_step: Callable[[StageProgress, StageState], None] = lambda progress, state: None,
) -> StageState:
    """Optimise `scene` in place.

    Args:
        scene: the scene.
        stage: what to do.
        evidence: what the terms look at.
        seed: of the choice of frames.
        resume: steps done, moments and stopping state as `checkpoint.load_checkpoint` returns them.
        after_step: called after every step.

    Raises:
        InputError: the stage names an unknown group or term.
        FloatingPointError: the loss is not finite; names the terms.
    """
    image_terms = IMAGE_TERMS[stage.step]
    unknown = [name for name in stage.weights if name not in TERMS and name not in image_terms]
    if unknown:
        accepted = ", ".join([*image_terms, *TERMS])
        raise InputError(f"stage {stage.name}: expected terms out of {accepted}, found {unknown[0]!r}")
    optimizer = make_optimizer(scene, stage.lrs)
    state = StageState(0, optimizer, float("inf"), 0, float("nan"))
    if resume is not None:
        optimizer.load_state_dict(optimizer.state_dict() | {"state": resume["moments"]})
        state = state._replace(**{key: resume[key] for key in ("step", "best", "best_step", "smoothed")})

    entities = stage_entities(scene, stage)
    frozen = {
        entity
        for entity in entities
        if not set(FIELD_GROUPS["object" if entity == "object" else "hand"]) & set(stage.lrs)
    }
    needs_canonical = any(
        name in image_terms or name in ("color", "scale", "lbs", "offset") for name in stage.weights
    )
    with torch.no_grad():
        # A frozen field is evaluated once for the whole stage.
        fixed = scene.canonical(frozen) if needs_canonical else {}

    while state.step < stage.steps and not _has_settled(stage, state):
        began = time.perf_counter()
        moving = [entity for entity in entities if entity not in frozen] if needs_canonical else []
        step = Step(
            scene,
            evidence,
            entities if needs_canonical else (),
            {**fixed, **scene.canonical(moving)},
            choose_frames(scene.n_frames, stage, seed, state.step),
        )
        terms = {}
        for name in stage.weights:
            try:
                terms[name] = (image_terms.get(name) or TERMS[name])(step)
            except InputError as error:
                # The renderer refuses what is not finite; the user's poses were, so the optimisation did it.
                where = f"stage {stage.name}, step {state.step}"
                raise FloatingPointError(f"{where}: {name} is not finite: {error}") from error
        loss = weighted_sum(terms, stage.weights)
        if not torch.isfinite(loss):
            bad = [name for name, value in terms.items() if not torch.isfinite(value)]
            raise FloatingPointError(f"stage {stage.name}, step {state.step}: {', '.join(bad)} is not finite")
        set_cosine_rates(optimizer, state.step / max(stage.steps, 1), stage.final_lr)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        state = _advance(stage, state, float(loss.detach()))
        after_step(
            StageProgress(
                state.step,
                stage.steps,
                {name: float(value.detach()) for name, value in terms.items()},
                float(loss.detach()),
                time.perf_counter() - began,
            ),
            state,
        )
    return state


def _advance(stage: OptimizeStage, state: StageState, loss: float) -> StageState:
    smoothed = loss if state.step == 0 else 0.9 * state.smoothed + 0.1 * loss
    improved = smoothed < state.best * (1.0 - stage.stop_gain)
    return state._replace(
        step=state.step + 1,
        smoothed=smoothed,
        best=smoothed if improved else state.best,
        best_step=state.step if improved else state.best_step,
    )


def _has_settled(stage: OptimizeStage, state: StageState) -> bool:
    return stage.stop_patience > 0 and state.step - state.best_step > stage.stop_patience

"""One stage of optimisation: the same loop for every stage, which differ in data only."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bigs.checks import InputError
from bigs.losses.weighted import weighted_sum
from bigs.models.free_gaussians import FreeGaussians
from bigs.models.object_splats import ObjectSplats
from bigs.models.occlusion import measure_occlusion
from bigs.models.scene import Scene
from bigs.threads import torch_alone
from bigs.train.loop.adam import FrameAdam
from bigs.train.loop.density import Pull, densified
from bigs.train.loop.optim import FIELD_GROUPS, make_optimizer, set_rates
from bigs.train.loop.outside import seconds_outside
from bigs.train.loop.step import Evidence, Selection, Step
from bigs.train.loop.terms import Term, terms_of
from bigs.train.plan.config import OptimizeStage
from bigs.train.plan.densify_config import DensifyConfig
from bigs.types import Entity


class StageProgress(NamedTuple):
    """The argument of hooks after every step."""

    step: int  # steps done
    steps: int  # steps planned
    terms: dict[str, float]
    loss: float
    seconds: float  # of this step
    fields_spared: float  # seconds that it would have taken to evaluate fields that the stage does not train
    pixels_spared: float  # seconds that pixels in which nothing ever is would have taken


class StageState(NamedTuple):
    """The state needed to continue a stage exactly: steps done, and the optimiser with its moments."""

    step: int
    optimizer: FrameAdam
    recent: Sequence[float]  # the last losses, as many as the stopping rule compares
    retreats: int  # number of retreats after non-finite values
    found: Mapping[str, Tensor]  # the stage's start by name, if it needs it
    pull: Pull | None  # gradients at the object's Gaussians since the last densification

    @classmethod
    def begun(cls, step: int, optimizer: FrameAdam, found: Mapping[str, Tensor] | None = None) -> StageState:
        """After `step` steps, of whose losses nothing is known yet."""
        return cls(step, optimizer, (), 0, found or {}, None)


# The parts of `StageState` that are plain numbers, or some.
NUMBERS = ("step", "recent", "retreats")
# A stage gives up after this many retreats; each halves its rates.
MOST_RETREATS = 4


def stage_entities(scene: Scene, stage: OptimizeStage) -> tuple[Entity, ...]:
    """The subjects a stage renders: all together, or alone those of which something may move."""
    if stage.step == "interacting-subjects":
        return scene.entities
    subjects = {group.split(".")[0] for group in stage.lrs}
    return tuple(
        entity
        for entity in scene.entities
        if ("object" if entity == "object" else "hand") in subjects
        and not (stage.free_frames and entity != "object" and len(scene.free_frames(entity)) == 0)
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
    keep_every: int = 100,
    warn: Callable[[str], None] = lambda text: None,
) -> StageState:
    """Optimise `scene` in place.

    A step whose loss or gradient is not finite is not taken: the stage goes back to the last state that was
    kept and on from there at half its rates.

    Args:
        scene: the scene.
        stage: what to do.
        evidence: what the terms look at.
        seed: of the choice of frames.
        resume: steps done, moments and stopping state as `checkpoint.load_checkpoint` returns them.
        after_step: called after every step.
        keep_every: steps between the states that are kept to go back to.
        warn: told what was not finite, and where the stage went back to.

    Raises:
        InputError: the stage names an unknown group or term.
        FloatingPointError: losses or gradients are not finite however small the steps; names the first.
    """
    terms = terms_of(stage, f"stage {stage.name}")
    if "perceptual" in stage.weights and evidence.perceptual is None:
        raise InputError(f"stage {stage.name}: expected a network for the term 'perceptual', found none")
    if "sds" in stage.weights and evidence.denoiser is None:
        raise InputError(f"stage {stage.name}: expected a prior's model for the term 'sds', found none")
    if resume is None and "scene.ambient" in stage.lrs and scene.lighting is not None:
        measure_occlusion(scene)
    optimizer = make_optimizer(scene, stage.lrs, stage.adam_betas, stage.frame_moments)
    state = StageState.begun(0, optimizer)
    densify = None if scene.object_splats is None else stage.densify
    if densify is not None:
        state = state._replace(pull=Pull.none(len(_field_of_object(scene, stage).base_points)))
    if resume is not None:
        optimizer.set_moments(resume["moments"])
        state = state._replace(**{key: resume[key] for key in NUMBERS}, pull=resume["pull"])

    entities = stage_entities(scene, stage)
    frozen = {
        entity
        for entity in entities
        if not set(FIELD_GROUPS["object" if entity == "object" else "hand"]) & set(stage.lrs)
    }
    needs_canonical = any(term.canonical for term in terms.values())
    began = time.perf_counter()
    with torch.no_grad():
        # A frozen field is evaluated once for the whole stage.
        fixed = scene.canonical(frozen) if needs_canonical else {}
    once, fields_spared = time.perf_counter() - began if fixed else 0.0, 0.0
    pixels_spared: float | None = None

    evaluated = [entity for entity in entities if entity not in frozen] if needs_canonical else []
    torch_threads = torch_alone if _is_light(scene, stage, evaluated) else nullcontext
    kept = _Kept(scene, state)
    while state.step < stage.steps and not _has_settled(stage, state):
        began = time.perf_counter()
        frames = choose_frames(scene.n_frames, stage, seed, state.step)
        selection = Selection(
            frames,
            entities if needs_canonical else (),
            labels="labels" in terms,
            seed=seed * 1_000_003 + state.step,
            free_frames=stage.free_frames,
            progress=state.step / max(stage.steps, 1),
            pull=densify is not None and "object" in evaluated and densify.watches(stage.steps, state.step),
        )
        with torch_threads():
            step = Step(scene, evidence, {**fixed, **scene.canonical(evaluated)}, selection)
            values, problem = _evaluate(step, terms)
            loss = weighted_sum(values, stage.weights) if problem is None else None
            if loss is not None:
                optimizer.zero_grad()
                # No gradient where no term has anything to look at, as those of free Gaussians beside fields.
                if loss.requires_grad:
                    loss.backward()
                if stage.free_frames:
                    _spare_grasps(scene)
                problem = _unbounded_gradient(scene, optimizer)
        if loss is None or problem is not None:
            where = f"stage {stage.name}, step {state.step}: {problem}"
            if state.retreats == MOST_RETREATS:
                raise FloatingPointError(where)
            state = kept.restore(scene, optimizer)._replace(retreats=state.retreats + 1)
            warn(f"{where}; back to step {state.step} with half the rates")
            continue
        set_rates(optimizer, selection.progress, stage.final_lr, 0.5**state.retreats, stage.decay)
        optimizer.step_frames(frames)
        state = _advance(stage, state, float(loss.detach()))
        if densify is not None:
            state = _densify(scene, step, densify, stage.steps, state)
        if state.step % keep_every == 0:
            kept = _Kept(scene, state)
        if pixels_spared is None:
            pixels_spared = seconds_outside(step)
        after_step(
            StageProgress(
                state.step,
                stage.steps,
                dict(zip(values, torch.stack(list(values.values())).tolist(), strict=True)),
                float(loss.detach()),
                time.perf_counter() - began,
                fields_spared,
                pixels_spared,
            ),
            state,
        )
        fields_spared = once
    return state


def _is_light(scene: Scene, stage: OptimizeStage, evaluated: Sequence[Entity]) -> bool:
    """Whether torch has little to do in each of a step's operations, so that a second thread would not help.

    Fields and networks are much work. What else is, the compiled code does.
    """
    fields = [entity for entity in evaluated if not isinstance(scene.splats(entity), FreeGaussians)]
    return not fields and not {"perceptual", "sds"} & set(stage.weights)


def _field_of_object(scene: Scene, stage: OptimizeStage) -> ObjectSplats:
    if not isinstance(scene.object_splats, ObjectSplats):
        raise InputError(
            f"stage {stage.name}: expected densify in a stage in which the object has a field, "
            "found free Gaussians"
        )
    return scene.object_splats


def _densify(scene: Scene, step: Step, config: DensifyConfig, steps: int, state: StageState) -> StageState:
    """Add a step to what is known of the object's Gaussians; clone, split and prune them when it is time."""
    gathered = step.object_pull() if step.selection.pull else None
    pull = state.pull if gathered is None else state.pull.plus(*gathered)
    if config.is_due(steps, state.step):
        splats = scene.object_splats
        with torch.no_grad():
            whole = splats()
        splats.place(densified(splats.anchors, whole, pull, config, splats.config.isotropic))
        pull = Pull.none(len(splats.base_points))
    return state._replace(pull=pull)


def _spare_grasps(scene: Scene) -> None:
    """Zero the gradient of frames in which a hand holds the object, so that they stay as they are."""
    for side, poses in scene.hand_poses.items():
        grasped = scene.grasps[side].of_frame >= 0
        for residual in (poses.orient, poses.pose, poses.position.ray, poses.position.log_depth):
            if residual.grad is not None:
                residual.grad[grasped] = 0.0


def _evaluate(step: Step, terms: Mapping[str, Term]) -> tuple[dict[str, Tensor], str | None]:
    """The values of terms, and which of them is not finite."""
    values = {}
    for name, term in terms.items():
        try:
            values[name] = term.loss(step)
        except InputError as error:
            # The renderer refuses non-finite input; the user's poses were finite, so the optimisation is at
            # fault.
            return values, f"{name} is not finite: {error}{_first_unbounded(step.scene)}"
    if _all_finite(values.values()):
        return values, None
    bad = [name for name, value in values.items() if not torch.isfinite(value)]
    return values, f"{', '.join(bad)} is not finite{_first_unbounded(step.scene)}"


def _all_finite(scalars: Iterable[Tensor]) -> bool:
    # One by one would be as many small operations as a term has.
    return bool(torch.stack(list(scalars)).isfinite().all())


def _first_unbounded(scene: Scene) -> str:
    """The first parameter that is not finite, with its place: for per-frame parameters that is the frame."""
    for name, values in scene.named_parameters():
        wrong = torch.nonzero(~torch.isfinite(values))
        if len(wrong):
            return f" ({name} at {wrong[0].tolist()})"
    return ""


def _unbounded_gradient(scene: Scene, optimizer: FrameAdam) -> str | None:
    # A sum is finite only if every value is, except for overflow, which is as bad.
    sums = [p.grad.sum() for p in optimizer.parameters() if p.grad is not None]
    if not sums or _all_finite(sums):
        return None
    name, gradient = next(
        (name, p.grad)
        for name, p in scene.named_parameters()
        if p.grad is not None and not torch.isfinite(p.grad.sum())
    )
    wrong = torch.nonzero(~torch.isfinite(gradient))
    place = f" at {wrong[0].tolist()}" if len(wrong) else ""
    return f"the gradient of {name} is not finite{place}"


class _Kept:
    """A state to go back to: copies of what is trained and of the optimiser's moments.

    Where the object's field is evaluated is not changed in place, so it needs no copy.
    """

    def __init__(self, scene: Scene, state: StageState) -> None:
        self._state = state
        self._anchors = None if state.pull is None else scene.object_splats.anchors
        self._values = [p.detach().clone() for p in state.optimizer.parameters()]
        self._moments = copy.deepcopy(state.optimizer.moments())

    @torch.no_grad()
    def restore(self, scene: Scene, optimizer: FrameAdam) -> StageState:
        if self._anchors is not None:
            scene.object_splats.place(self._anchors)
        for parameter, value in zip(optimizer.parameters(), self._values, strict=True):
            parameter.copy_(value)
        optimizer.set_moments(self._moments)
        return self._state


def _advance(stage: OptimizeStage, state: StageState, loss: float) -> StageState:
    window = 2 * stage.stop_patience
    return state._replace(step=state.step + 1, recent=[*state.recent, loss][-window:] if window else ())


def _has_settled(stage: OptimizeStage, state: StageState) -> bool:
    half = stage.stop_patience
    if half == 0 or len(state.recent) < 2 * half:
        return False
    # Not the lowest so far, since Adam's first steps often lead away from a good start.
    before, now = sum(state.recent[:half]), sum(state.recent[half:])
    return abs(now - before) < stage.stop_gain * abs(now)

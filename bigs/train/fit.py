"""Run a plan of stages on a clip: the one function that turns estimates into a fitted scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.data.focal import with_focal_factor
from bigs.data.oddities.brightness import brightened
from bigs.guidance.denoiser import Denoiser
from bigs.hand import HandModel
from bigs.losses.perceptual import VggWeights
from bigs.models.hand_detail import free_hand
from bigs.models.object_detail import ObjectDetail, split_object
from bigs.models.scene import Scene
from bigs.motion.tracker import TrackedMotion
from bigs.threads import beside
from bigs.train.digest import run_digest
from bigs.train.fit_report import FROZEN, OUTSIDE, SETTLED, FitReport
from bigs.train.grasps.depth_search import search_grasp_depths
from bigs.train.grasps.find import find_grasps
from bigs.train.grasps.scale_search import search_object_scale
from bigs.train.loop.checkpoint import load_checkpoint, save_checkpoint
from bigs.train.loop.evidence import EvidenceSource
from bigs.train.loop.refinement import refined
from bigs.train.loop.run_stage import StageProgress, StageState, run_stage
from bigs.train.loop.stopwatch import Stopwatch
from bigs.train.loop.target_source import TargetSource
from bigs.train.moves.search import search_moves
from bigs.train.plan.config import (
    CompletionStage,
    GraspDepthStage,
    GraspStage,
    GuidanceStage,
    MoveStage,
    ObjectMotionStage,
    OptimizeStage,
    PictureStage,
    RefineStage,
    RunConfig,
    ScaleSearchStage,
    SplitStage,
    Stage,
)
from bigs.train.plan.rate import at_rate
from bigs.train.resolve import asks_prior
from bigs.train.start.background import unknown_occluders
from bigs.train.start.build import build_scene
from bigs.train.start.initial import initial_trajectory
from bigs.train.start.object_motion import find_object_motion, in_words
from bigs.train.unseen.stages import OBSERVED_AT, finish_mesh, run_completion, run_guidance
from bigs.train.unseen.visibility import shown
from bigs.types import Side


class Waypoint(NamedTuple):
    """How far a run has come."""

    stage: str  # of the plan, or "start values"
    step: int | None  # steps of the stage done; None at its end


# A Gaussian less free than this stays whole: its parts would hardly learn to close the gaps between them.
_LEARNS = 0.5

# Receives plain dicts: {"event": "stage" | "step" | "note", ...}
Listener = Callable[[dict[str, Any]], None]
# Looks at the scene after the start values, every step and every stage, and leaves it as it is.
Observer = Callable[[Scene, Waypoint], None]


def fit(
    clip: Clip,
    hand_models: Mapping[Side, HandModel],
    config: RunConfig,
    *,
    perceptual: VggWeights | None = None,
    denoiser: Denoiser | None = None,
    checkpoints: Path | None = None,
    resume: bool = False,
    listen: Listener = lambda event: None,
    watch: Stopwatch | None = None,
    observe: Observer | None = None,
) -> tuple[Scene, FitReport]:
    """Fit a scene to a clip.

    Args:
        clip: the loaded clip.
        hand_models: both sides' models.
        config: what to do; `resolve` leaves out what it has no network for.
        perceptual: the network for the term of that name.
        denoiser: the diffusion prior of the plan's `GuidanceStage`.
        checkpoints: folder for checkpoints; None keeps none.
        resume: continue from the checkpoint there, if there is one.
        listen: told of stages, steps and notes as they happen.
        watch: goes on through the stages; a new one if not given. It stands still while `observe` looks.
        observe: sees the scene along the way.

    Raises:
        InputError: the configuration names unknown groups or terms or needs a network that is not given, or
            the checkpoint is of another run.
        FloatingPointError: a loss became infinite or not a number.
    """
    report = FitReport()
    config = at_rate(config, clip.fps if clip.pace is None else clip.pace)
    _check_networks(config, perceptual, denoiser)
    torch.manual_seed(config.seed)
    watch = watch or Stopwatch("start values")
    watch.begin("start values")
    clip = brightened(clip)
    if clip.brightness < 1.0:
        times = f"{1.0 / clip.brightness:.1f} times"
        dark, pale = f"dark; fitted as if {times} as bright", f"pale; fitted with {times} the contrast"
        report.facts["pictures"] = dark if clip.black == 0.0 else pale
    # Few of the tracker's operations are parallel, so there is a core to spare beside it.
    occluders = beside().submit(unknown_occluders, clip, initial_trajectory(clip, hand_models).joints)
    motion = None
    if config.stages and isinstance(config.stages[0], ObjectMotionStage):
        watch.begin(config.stages[0].name)
        motion = _object_motion(clip, config, config.stages[0], checkpoints, report, listen)
        if motion is not None:
            wrists = {side: hand_models[side].rest_wrist(track.betas) for side, track in clip.hands.items()}
            clip = with_focal_factor(clip, wrists, motion.focal)
        watch.begin("start values")
    unknown, moving = occluders.result()
    if moving:
        report.facts["background"] = moving
    targets = TargetSource(clip, unknown)
    targets.make_ahead(_image_sizes(config.stages))
    start = build_scene(
        clip,
        unknown,
        hand_models,
        config.initial,
        config.hand,
        config.object,
        config.lighting,
        config.prior.completion if any(isinstance(s, CompletionStage) for s in config.stages) else None,
        motion,
    )
    scene = start.scene
    scene.black, scene.brightness = clip.black, clip.brightness
    gaussians = 0 if scene.object_splats is None else len(scene.object_splats.base_points)
    report.skipped += start.skipped
    report.seconds = watch.read()
    digest = run_digest(clip, scene, config, perceptual, denoiser)
    position = load_checkpoint(checkpoints, scene, digest) if checkpoints and resume else None
    first = position.stage if position else 0
    if position:
        done = position.resume["step"] if position.resume else 0
        listen({"event": "resume", "index": first, "step": done})
        report = FitReport(**position.report)
        report.before = sum(report.seconds.values())
        watch.add(report.seconds)
    sources = EvidenceSource(targets, scene, config, perceptual, denoiser)

    def keep(index: int, state: StageState | None) -> None:
        """Save the state of the running stage, or of the one that has just ended."""
        report.seconds = watch.read()
        if checkpoints:
            save_checkpoint(checkpoints, scene, digest, index, state, asdict(report))

    def show(stage: str, step: int | None) -> None:
        if observe is not None:
            with watch.paused():
                observe(scene, Waypoint(stage, step))

    def listen_and_show(event: dict[str, Any]) -> None:
        listen(event)
        if event["event"] == "step":
            show(event["stage"], event["step"])

    if position is None:
        show("start values", None)
    for index, stage in enumerate(config.stages):
        if index < first or isinstance(stage, ObjectMotionStage):
            continue
        why = _not_needed(stage, scene, report)
        if why:
            report.skipped.append(f"{stage.name}: {why}")
            continue
        listen({"event": "stage", "stage": stage.name, "index": index, "stages": len(config.stages)})
        watch.begin(stage.name)
        targets.make_ahead(_image_sizes(config.stages[index:]))
        continues = position.resume if position and index == first else None
        if isinstance(stage, ScaleSearchStage):
            size = search_object_scale(scene, stage, sources.certainty(), sources.occlusion(stage))
            listen({"event": "note", "stage": stage.name, "text": f"object size x {size.text()}"})
            report.add_fact("object size", f"x {size.text()} by where hands touch it")
        elif isinstance(stage, GraspStage):
            grasps = find_grasps(scene, stage, sources.meeting, sources.mismatch(stage))
            for side, found in grasps.items():
                text = f"{side} hand holds the object in frames {found.text()}"
                listen({"event": "note", "stage": stage.name, "text": text})
        elif isinstance(stage, GraspDepthStage):
            depths = search_grasp_depths(scene, stage, sources.seen(stage))
            listen({"event": "note", "stage": stage.name, "text": f"object size x {depths.text()}"})
            report.add_fact("object size", f"x {depths.text()} by the depths of grasps")
            for side in scene.sides:
                text = f"{side} hand: distances of grasps {depths.text_of(side)}"
                listen({"event": "note", "stage": stage.name, "text": text})
        elif isinstance(stage, MoveStage):
            moved = search_moves(scene, stage, sources.evidence(stage), sources.mismatch(stage))
            for side, moves in moved.items():
                listen({"event": "note", "stage": stage.name, "text": f"{side} hand: {moves.text()}"})
        elif isinstance(stage, SplitStage):
            for text in _split(scene, stage, sources):
                listen({"event": "note", "stage": stage.name, "text": text})
        elif isinstance(stage, RefineStage):
            listen({"event": "note", "stage": stage.name, "text": _refine(scene, stage, sources)})
        elif isinstance(stage, CompletionStage | GuidanceStage):
            if isinstance(stage, CompletionStage):
                done = run_completion(scene, stage, sources, config, start.symmetries)
                report.completed = done.skipped is None
            else:
                done = run_guidance(
                    scene, stage, index, sources, config, denoiser, continues, keep, listen_and_show
                )
            if done.skipped:
                report.skipped.append(f"{stage.name}: {done.skipped}")
            report.facts |= done.facts
        else:
            last = _optimise(scene, stage, index, sources, config, continues, keep, report, listen_and_show)
            if last.step < stage.steps:
                left = stage.steps - last.step
                saved = watch.read()[stage.name] / last.step * left
                report.spare(SETTLED, saved)
                report.skipped.append(
                    f"{stage.name}: {left} of {stage.steps} steps, the loss had settled ({saved:.1f} s saved)"
                )
            if last.pull is not None:
                now = len(scene.object_splats.base_points)
                report.facts["object Gaussians"] = f"{gaussians} at the start, {now} after {stage.name}"
        keep(index + 1, None)
        show(stage.name, None)
    watch.begin("object mesh")
    scene.requires_grad_(False)
    if "object size" in report.facts:
        report.facts["object size"] += (
            f"; in the end {scene.object_poses.log_scale.exp():.3f} of the estimate's"
        )
    left_out = report.left_out(1.0 - targets.cropped())
    if left_out:
        report.facts["left out"] = left_out
    report.facts |= finish_mesh(scene, start, sources, config, report.completed)
    report.seconds = watch.read()
    return scene, report


def _image_sizes(stages: Sequence[Stage]) -> list[int]:
    """The sizes at which stages look at the clip's images, in their order."""
    sizes = []
    for stage in stages:
        if isinstance(stage, PictureStage):
            sizes.append(stage.image_size)
        elif not isinstance(stage, ObjectMotionStage):
            sizes.append(OBSERVED_AT.image_size)
    return sizes


def _object_motion(
    clip: Clip,
    config: RunConfig,
    stage: ObjectMotionStage,
    folder: Path | None,
    report: FitReport,
    listen: Listener,
) -> TrackedMotion | None:
    """The stage that runs before the start values, since they depend on its result."""
    listen({"event": "stage", "stage": stage.name, "index": 0, "stages": len(config.stages)})
    motion = find_object_motion(clip, config.initial, stage, folder)
    if motion is None:
        report.skipped.append(f"{stage.name}: the clip has no object in its masks")
    else:
        listen({"event": "note", "stage": stage.name, "text": in_words(motion)})
        report.facts["object motion"] = in_words(motion)
    return motion


def _split(scene: Scene, stage: SplitStage, sources: EvidenceSource) -> list[str]:
    """Free the scene's Gaussians of their fields; returns what to report."""
    notes = []
    freedom = shown(scene, sources.evidence(OBSERVED_AT))
    if stage.hands:
        for side, hand in scene.hand_splats.items():
            scene.hand_splats[side] = free_hand(hand, freedom[side])
            notes.append(f"{len(scene.hand_splats[side].shift)} Gaussians of the hand are free")
    if scene.object_splats is not None:
        with torch.no_grad():
            whole = scene.object_splats()
        parts = torch.where(freedom["object"] < _LEARNS, 1, stage.parts)
        scene.object_splats = split_object(
            whole, parts, stage.least_opacity, freedom["object"], stage.overlap
        )
        notes.append(_become(len(whole.means), scene.object_splats))
    return notes


def _refine(scene: Scene, stage: RefineStage, sources: EvidenceSource) -> str:
    """Split the object's Gaussians where it pays; returns what to report."""
    coarse = scene.object_splats
    freedom = shown(scene, sources.evidence(OBSERVED_AT))["object"]
    scene.object_splats = refined(scene, coarse, stage, sources.evidence(stage), freedom)
    return _become(len(coarse.shift), scene.object_splats)


def _become(before: int, now: ObjectDetail) -> str:
    return f"{before} Gaussians of the object become {len(now.shift)}"


def _optimise(
    scene: Scene,
    stage: OptimizeStage,
    index: int,
    sources: EvidenceSource,
    config: RunConfig,
    resume: dict[str, Any] | None,
    keep: Callable[[int, StageState | None], None],
    report: FitReport,
    listen: Listener,
) -> StageState:
    def after_step(progress: StageProgress, state: StageState) -> None:
        told = progress._asdict()
        report.spare(FROZEN, told.pop("fields_spared"))
        report.spare(OUTSIDE, told.pop("pixels_spared"))
        listen({"event": "step", "stage": stage.name, **told, "index": index})
        if progress.step % config.checkpoint_every == 0 and progress.step < stage.steps:
            keep(index, state)

    def warn(text: str) -> None:
        listen({"event": "note", "stage": stage.name, "text": text})
        report.retreats.append(text)

    return run_stage(
        scene,
        stage,
        sources.evidence(stage),
        config.seed + 1000 * index,
        resume,
        after_step,
        config.checkpoint_every,
        warn,
    )


def _check_networks(config: RunConfig, perceptual: VggWeights | None, denoiser: Denoiser | None) -> None:
    for stage in config.stages:
        if isinstance(stage, OptimizeStage) and "perceptual" in stage.weights and perceptual is None:
            raise InputError(f"stage {stage.name}: expected a network for the term 'perceptual', found none")
        if asks_prior(stage) and denoiser is None:
            raise InputError(f"stage {stage.name}: expected a prior's model, found none")


def _not_needed(stage: Stage, scene: Scene, report: FitReport) -> str | None:
    """Why a stage has nothing to do on this clip, or None."""
    if isinstance(stage, ScaleSearchStage | GraspStage | GraspDepthStage):
        if scene.object_splats is None or not scene.sides:
            return "the clip has no hand and object together"
        grasped = any(grasps.count for grasps in scene.grasps.values())
        return "no hand holds the object" if isinstance(stage, GraspDepthStage) and not grasped else None
    if isinstance(stage, CompletionStage | GuidanceStage | RefineStage) and scene.object_splats is None:
        return "the clip has no object"
    if isinstance(stage, MoveStage):
        return None if scene.sides else "the clip has no hand"
    if isinstance(stage, CompletionStage | RefineStage):
        return None
    if isinstance(stage, GuidanceStage):
        return "symmetry has completed the object" if report.completed else None
    if isinstance(stage, SplitStage):
        return "the clip has no object" if scene.object_splats is None and not stage.hands else None
    if not stage.weights:
        return "no loss term is left"
    if stage.free_frames and not any(len(scene.free_frames(side)) for side in scene.sides):
        return "the hands hold the object in every frame"
    # The clip's light and shade alone are no subject.
    subjects = {group.split(".")[0] for group in stage.lrs} - {"scene"}
    if subjects == {"hand"} and not scene.sides:
        return "the clip has no hand"
    if subjects == {"object"} and scene.object_splats is None:
        return "the clip has no object"
    return None

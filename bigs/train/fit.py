"""Run a plan of stages on a clip: the one function that turns estimates into a fitted scene."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import bigs
from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.models.hand_splats import CanonicalHand, silhouette_hand
from bigs.models.scene import Scene
from bigs.train.background import unknown_occluders
from bigs.train.build import build_scene
from bigs.train.checkpoint import load_checkpoint, save_checkpoint
from bigs.train.config import OptimizeStage, RunConfig, ScaleSearchStage, Stage
from bigs.train.initial import touching_frames
from bigs.train.loop import StageProgress, StageState, run_stage
from bigs.train.scale_search import search_object_scale
from bigs.train.targets import Targets, crop_box, load_targets
from bigs.train.terms import Evidence
from bigs.types import Side

# Standard deviation of the Gaussians that stand for a hand in the silhouette term, metres.
SILHOUETTE_SIGMA = 0.0022


@dataclass
class FitReport:
    """What happened, for logs and tables."""

    seconds: dict[str, float] = field(default_factory=dict)  # per stage
    skipped: list[str] = field(default_factory=list)  # what was not done, and why


# Receives plain dicts: {"event": "stage" | "step" | "note", ...}
Listener = Callable[[dict[str, Any]], None]


def fit(
    clip: Clip,
    hand_models: Mapping[Side, HandModel],
    config: RunConfig,
    *,
    checkpoints: Path | None = None,
    resume: bool = False,
    listen: Listener = lambda event: None,
) -> tuple[Scene, FitReport]:
    """Fit a scene to a clip.

    Args:
        clip: the loaded clip.
        hand_models: both sides' models.
        config: what to do.
        checkpoints: folder for checkpoints; None keeps none.
        resume: continue from the checkpoint there, if there is one.
        listen: told of stages, steps and notes as they happen.

    Raises:
        InputError: the configuration names unknown groups or terms, or the checkpoint is of another run.
        FloatingPointError: a loss became infinite or not a number.
    """
    report = FitReport()
    torch.manual_seed(config.seed)
    began = time.perf_counter()
    unknown = unknown_occluders(clip)
    scene, notes = build_scene(
        clip, unknown, hand_models, config.initial, config.hand, config.object, config.lighting
    )
    report.skipped += notes
    report.seconds["start values"] = time.perf_counter() - began
    digest = run_digest(clip, scene, config)
    position = load_checkpoint(checkpoints, scene, digest) if checkpoints and resume else None
    first = position.stage if position else 0
    sources = _EvidenceSource(clip, unknown, scene, config)

    for index, stage in enumerate(config.stages):
        if index < first:
            continue
        why = _not_needed(stage, scene)
        if why:
            report.skipped.append(f"{stage.name}: {why}")
            continue
        listen({"event": "stage", "stage": stage.name, "index": index, "stages": len(config.stages)})
        began = time.perf_counter()
        if isinstance(stage, ScaleSearchStage):
            factor, _, _ = search_object_scale(scene, stage, sources.touching)
            listen({"event": "note", "stage": stage.name, "text": f"object size x {factor:.3f}"})
        else:
            continues = position.resume if position and index == first else None
            last = _optimise(scene, stage, index, sources, config, continues, checkpoints, digest, listen)
            if last.step < stage.steps:
                report.skipped.append(
                    f"{stage.name}: {stage.steps - last.step} of {stage.steps} steps, the loss had settled"
                )
        report.seconds[stage.name] = time.perf_counter() - began
        if checkpoints:
            save_checkpoint(checkpoints, scene, digest, index + 1, None)
    scene.requires_grad_(False)
    return scene, report


def _optimise(
    scene: Scene,
    stage: OptimizeStage,
    index: int,
    sources: _EvidenceSource,
    config: RunConfig,
    resume: dict[str, Any] | None,
    checkpoints: Path | None,
    digest: str,
    listen: Listener,
) -> StageState:
    def after_step(progress: StageProgress, state: StageState) -> None:
        listen({"event": "step", "stage": stage.name, **progress._asdict()})
        if checkpoints and progress.step % config.checkpoint_every == 0 and progress.step < stage.steps:
            save_checkpoint(checkpoints, scene, digest, index, state)

    return run_stage(scene, stage, sources.evidence(stage), config.seed + 1000 * index, resume, after_step)


def _not_needed(stage: Stage, scene: Scene) -> str | None:
    """Why a stage has nothing to do on this clip, or None."""
    if isinstance(stage, ScaleSearchStage):
        if scene.object_splats is None or not scene.sides:
            return "the clip has no hand and object together"
        return None
    subjects = {group.split(".")[0] for group in stage.lrs}
    if subjects == {"hand"} and not scene.sides:
        return "the clip has no hand"
    if subjects == {"object"} and scene.object_splats is None:
        return "the clip has no object"
    return None


def run_digest(clip: Clip, scene: Scene, config: RunConfig) -> str:
    """Identifies what a checkpoint belongs to: version, configuration and the start values it led to."""
    text = json.dumps([bigs.__version__, clip.name, list(clip.frame_names), asdict(config)], sort_keys=True)
    digest = hashlib.sha256(text.encode())
    for poses in scene.hand_poses.values():
        digest.update(poses.base_pose.numpy().tobytes())
    for splats in scene.hand_splats.values():
        digest.update(splats.model.v_template.numpy().tobytes())
    if scene.object_splats is not None:
        digest.update(scene.object_splats.base_points.numpy().tobytes())
    return digest.hexdigest()[:16]


class _EvidenceSource:
    """Makes each stage's evidence; what several stages share is made once, when first asked for."""

    def __init__(self, clip: Clip, unknown: np.ndarray, scene: Scene, config: RunConfig) -> None:
        self.clip = clip
        self.unknown = unknown
        self.scene = scene
        self.config = config
        self.box = crop_box(clip)
        self.touching: dict[Side, Tensor] = {
            side: torch.as_tensor(touching_frames(clip, side), dtype=torch.float32)
            if scene.object_splats is not None
            else torch.zeros(len(clip))
            for side in scene.sides
        }
        self._targets: dict[int, Targets] = {}

    def evidence(self, stage: OptimizeStage) -> Evidence:
        targets = self.targets(stage.image_size)
        silhouettes = {side: self._silhouette(side, targets) for side in self.scene.sides}
        return Evidence(targets, self.touching, silhouettes, self.config.contact, self.config.raster)

    def targets(self, size: int) -> Targets:
        if size not in self._targets:
            long_side = max(self.clip.width, self.clip.height)
            scale = min(1.0, size / long_side) if size else 1.0
            # One resolution at a time: a stage that returns to an earlier one is rare, memory is not.
            self._targets = {size: load_targets(self.clip, self.unknown, scale, self.box)}
        return self._targets[size]

    def _silhouette(self, side: Side, targets: Targets) -> CanonicalHand:
        """A hand whose outline lies right at this resolution.

        The rasteriser widens every Gaussian by eps2d square pixels, so the coarser the image, the further in
        the centres must go.
        """
        model = self.scene.hand_model(side)
        depth = self.scene.hand_poses[side].position.base_log_depth.exp().median()
        pixel = float(depth / targets.K[0, 0])
        spread = (SILHOUETTE_SIGMA**2 + self.config.raster.eps2d * pixel**2) ** 0.5
        return silhouette_hand(model, SILHOUETTE_SIGMA, INSET * spread)


# Centres go in by this many standard deviations of a Gaussian as it appears in the image. Opaque neighbours
# overlap, so their common alpha falls to one half well outside the centres.
INSET = 1.85


def check_plan(config: RunConfig) -> None:
    """Raise `InputError` when a plan has no stages or two of the same name."""
    names = [stage.name for stage in config.stages]
    if not names:
        raise InputError("config stages: expected at least one stage, found none")
    repeated = {name for name in names if names.count(name) > 1}
    if repeated:
        raise InputError(f"config stages: expected unique names, found {sorted(repeated)[0]!r} twice")

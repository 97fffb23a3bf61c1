"""The data of each stage: images at its size, touching frames, cheap silhouettes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from bigs.fused.pixels import coverage_squares
from bigs.guidance.denoiser import Denoiser
from bigs.hand import bends, impossible_turns
from bigs.losses.perceptual import VggWeights
from bigs.models.poses import HandFrames
from bigs.models.scene import Scene
from bigs.train.grasps.find import Mismatch
from bigs.train.loop.image_terms import labels
from bigs.train.loop.step import Evidence, Selection, Step, spread_frames
from bigs.train.loop.target_source import TargetSource
from bigs.train.plan.config import (
    GraspDepthStage,
    GraspStage,
    MoveStage,
    PictureStage,
    RunConfig,
    ScaleSearchStage,
)
from bigs.train.start.initial import touching_frames
from bigs.types import Side


class EvidenceSource:
    """Makes each stage's evidence; what several stages share is made once, when first asked for."""

    def __init__(
        self,
        targets: TargetSource,
        scene: Scene,
        config: RunConfig,
        perceptual: VggWeights | None,
        denoiser: Denoiser | None = None,
    ) -> None:
        self.clip = targets.clip
        self.unknown = targets.unknown
        self.targets = targets
        self.scene = scene
        self.config = config
        self.perceptual = perceptual
        self.denoiser = denoiser
        # Where the masks of hand and object meet.
        self.meeting: dict[Side, Tensor] = {
            side: torch.as_tensor(touching_frames(self.clip, side), dtype=torch.float32)
            if scene.object_splats is not None
            else torch.zeros(len(self.clip))
            for side in scene.sides
        }

    def touching(self) -> dict[Side, Tensor]:
        """For each hand [T] 1 where it touches the object, as far as is known by now.

        Masks also meet where a hand only passes before the object; once its grasps are found, they count.
        """
        touching = {}
        for side, meeting in self.meeting.items():
            grasps = self.scene.grasps[side]
            touching[side] = (grasps.of_frame >= 0).to(meeting) if grasps.count else meeting
        return touching

    def certainty(self) -> dict[Side, Tensor]:
        """For each hand [T] how sure it is that it touches the object: that of its grasps, once found."""
        return {
            side: self.scene.grasps[side].certainty if self.scene.grasps[side].count else touching
            for side, touching in self.touching().items()
        }

    def evidence(self, stage: PictureStage) -> Evidence:
        """What the terms of a stage look at, at its image size and as far as grasps are known by now."""
        targets = self.targets.at(stage.image_size)
        return Evidence(
            targets,
            self.touching(),
            {side: impossible_turns(self.scene.hand_model(side)) for side in self.scene.sides},
            {side: bends(self.scene.hand_model(side)) for side in self.scene.sides},
            self.config.contact,
            self.config.raster,
            self.perceptual,
            self.denoiser,
        )

    def occlusion(self, stage: ScaleSearchStage) -> Callable[[], float]:
        """The label term of the scene as it is, over some frames: which subject hides which."""
        evidence = self.evidence(stage)
        frames = spread_frames(len(self.clip), stage.frames)
        entities = self.scene.entities
        with torch.no_grad():
            canonical = self.scene.canonical(entities)
        return lambda: float(labels(Step(self.scene, evidence, canonical, Selection(frames, entities))))

    def mismatch(self, stage: GraspStage | MoveStage) -> Mismatch:
        """How badly a hand's outline, in any poses, disagrees with its masks; poses get a gradient."""
        evidence = self.evidence(stage)
        targets = evidence.targets
        step = Step(self.scene, evidence, {}, Selection(torch.arange(len(self.clip))))
        shown = targets.foreground.sum((1, 2)) > 0
        areas = {side: targets.shares[side].sum((1, 2)) for side in self.scene.sides}

        def ask(side: Side, poses: HandFrames, frames: Tensor) -> Tensor:
            alphas = step.covered(side, self.scene.hand_verts(side, poses))
            squares = coverage_squares(alphas, targets.shares[side], targets.hidden[side], frames)
            # A hand that hardly shows gives no reliable measure.
            area = areas[side].clamp_min(0.25 * areas[side].median())
            return torch.where(shown[frames], squares / area[frames], torch.nan)

        return ask

    @torch.no_grad()
    def seen(self, stage: GraspDepthStage) -> dict[Side, Tensor]:
        """For each hand [T] how much of what it covers its mask shows, in [0, 1], as the scene is."""
        evidence, frames = self.evidence(stage), torch.arange(len(self.clip))
        step = Step(self.scene, evidence, {}, Selection(frames))
        found = {}
        for side in self.scene.sides:
            covers = step.covered(side, self.scene.at(frames).verts(side))
            shows = (covers * evidence.targets.shares[side]).sum((1, 2))
            found[side] = shows / covers.sum((1, 2)).clamp_min(1.0)
        return found

"""Stages of a step or three on a cube between two hands, with random pictures for evidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from small_vgg import small_network
from torch import Tensor
from toy_scenes import cube_scene

from bigs.hand import HandModel, bends, impossible_turns
from bigs.models.scene import Scene
from bigs.raster import RasterSettings
from bigs.train.loop.step import Evidence
from bigs.train.loop.targets import Targets
from bigs.train.plan.config import OptimizeStage
from bigs.types import Side

FRAMES = 3

ALONE = OptimizeStage(
    name="alone",
    step="single-subject",
    steps=3,
    lrs={"hand.ray": 1e-3, "hand.color": 1e-3, "object.triplane": 1e-2, "object.appearance": 1e-2},
    weights={"image": 1.0, "coverage": 0.5, "silhouette": 1.0},
    frames_per_step=2,
)
TOGETHER = replace(ALONE, name="together", step="interacting-subjects", weights={"image": 1.0, "labels": 1.0})


def held_cube(hands: Mapping[Side, HandModel]) -> Scene:
    torch.manual_seed(0)
    return cube_scene(hands, frames=FRAMES)


def random_evidence(scene: Scene) -> Evidence:
    generator = torch.Generator().manual_seed(1)
    height, width = 30, 40
    owner = torch.randint(0, 4, (FRAMES, height, width), generator=generator)
    K = scene.K.clone()
    K[:2] *= 0.5
    targets = Targets(
        torch.rand(FRAMES, height, width, 3, generator=generator),
        {entity: (owner == i).float() for i, entity in enumerate(("right", "left", "object"))},
        torch.zeros(FRAMES, height, width),
        K,
        width,
        height,
    )
    touching = {side: torch.ones(FRAMES) for side in ("right", "left")}
    turns = {side: impossible_turns(scene.hand_model(side)) for side in scene.sides}
    bending = {side: bends(scene.hand_model(side)) for side in scene.sides}
    return Evidence(targets, touching, turns, bending, "surface", RasterSettings(), small_network())


def values(scene: Scene) -> dict[str, Tensor]:
    return {name: p.detach().clone() for name, p in scene.named_parameters()}

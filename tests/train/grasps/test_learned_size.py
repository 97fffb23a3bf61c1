"""The object's size from how large hands look in their grasps."""

from __future__ import annotations

import math

import pytest
import torch
from toy_scenes import turning_scene

from bigs.fused.outline import covered_shares
from bigs.models.scene import Scene
from bigs.raster import RasterSettings
from bigs.train.grasps.find import find_grasps
from bigs.train.loop.run_stage import run_stage
from bigs.train.loop.step import Evidence
from bigs.train.loop.targets import Targets
from bigs.train.plan.config import GraspStage, OptimizeStage

FRAMES = 8
STAGE = OptimizeStage(
    name="size",
    step="single-subject",
    steps=40,
    lrs={"object.scale": 0.004, "hand.grasp_position": 0.001},
    weights={"silhouette": 1.0},
    final_lr=0.1,
)


@torch.no_grad()
def outlines(scene: Scene) -> Evidence:
    """The hands' true outlines, as large as the clip's images; nothing hides anything."""
    posed = scene.at(torch.arange(FRAMES))
    size = (scene.width, scene.height)
    shares = {
        side: covered_shares(posed.verts(side), scene.hand_model(side).faces, scene.K, *size)
        for side in scene.sides
    }
    nothing = torch.zeros(FRAMES, scene.height, scene.width)
    targets = Targets(
        nothing[..., None].repeat(1, 1, 1, 3), shares | {"object": nothing}, nothing, scene.K, *size
    )
    return Evidence(targets, {}, {}, {}, "surface", RasterSettings())


def held(size: float) -> tuple[Scene, Evidence]:
    """Hands that hold an object of a wrong size, and go with it; their outlines at the true one."""
    scene = turning_scene(frames=FRAMES, turn=math.pi / 3)
    evidence = outlines(scene)
    find_grasps(scene, GraspStage(slack=0.0), {side: torch.ones(FRAMES) for side in scene.sides})
    with torch.no_grad():
        scene.object_poses.log_scale.fill_(math.log(size))
    return scene, evidence


@pytest.mark.parametrize("wrong", [0.96, 1.04])
def test_a_grasp_seen_from_several_sides_tells_it(wrong: float) -> None:
    scene, evidence = held(wrong)
    run_stage(scene, STAGE, evidence, 0)
    assert float(scene.object_poses.log_scale.detach().exp()) == pytest.approx(1.0, abs=0.008)

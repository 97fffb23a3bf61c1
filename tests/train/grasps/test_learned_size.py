"""The object's size from how large hands look in their grasps."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from toy_scenes import turning_scene

from bigs.fused.outline import covered_shares
from bigs.models.scene import Scene
from bigs.raster import RasterSettings
from bigs.train.grasps.find import find_grasps
from bigs.train.grasps.size_trials import try_sizes
from bigs.train.loop.run_stage import run_stage
from bigs.train.loop.step import Evidence
from bigs.train.loop.targets import Targets
from bigs.train.plan.config import GraspStage, OptimizeStage, SizeTrialsConfig
from bigs.train.plan.presets import PRESETS

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


@pytest.mark.parametrize("wrong", [0.92, 0.98, 1.07])
def test_steps_on_trial_tell_it_too(wrong: float) -> None:
    """With no rate for the size: positions in grasps, which go with the object, are all that moves."""
    scene, evidence = held(wrong)

    def losses(stage: OptimizeStage) -> list[float]:
        found: list[float] = []
        run_stage(scene, stage, evidence, 0, after_step=lambda progress, _: found.append(progress.loss))
        return found

    factor = try_sizes(scene, replace(STAGE, size_trials=SizeTrialsConfig()), losses)
    assert factor * wrong == pytest.approx(1.0, abs=0.015)


def test_without_a_grasp_it_stays() -> None:
    """The object's picture is the same at any size, and Adam takes full steps along mere rounding."""
    scene = turning_scene(frames=FRAMES, turn=math.pi / 3)
    pictured = replace(STAGE, step="interacting-subjects", weights={"image": 1.0})
    before = scene.object_poses.log_scale.clone()
    run_stage(scene, pictured, outlines(scene), 0)
    assert torch.equal(scene.object_poses.log_scale, before)


@pytest.mark.parametrize("name", ["fast", "full", "demo"])
def test_plans_learn_it_while_hands_hold_the_object(name: str) -> None:
    learned = {
        s.name for s in PRESETS[name].stages if isinstance(s, OptimizeStage) and "object.scale" in s.lrs
    }
    assert learned == {"grasped", "contact", "joint"}

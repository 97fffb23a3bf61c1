"""The object's size by steps on trial: the lowest loss after them is found, and they leave nothing else."""

from __future__ import annotations

import math

import pytest
import torch
from toy_scenes import cube_scene

from bigs.hand import HandModel
from bigs.models.scene import Scene
from bigs.train.grasps.size_trials import try_sizes
from bigs.train.plan.config import OptimizeStage, SizeTrialsConfig
from bigs.train.plan.densify_config import DensifyConfig
from bigs.types import Side

STAGE = OptimizeStage(
    name="contact",
    step="interacting-subjects",
    steps=40,
    lrs={"hand.pose": 0.01, "object.scale": 0.003},
    weights={"silhouette": 1.0},
    stop_patience=3,
    densify=DensifyConfig(),
    size_trials=SizeTrialsConfig(span=0.05, most=5, steps=6),
)


class Bowl:
    """Steps that lead to a loss which is lowest at a size, and leave a mess."""

    def __init__(self, scene: Scene, lowest: float) -> None:
        self.scene, self.lowest, self.stages = scene, lowest, []

    def __call__(self, stage: OptimizeStage) -> list[float]:
        self.stages.append(stage)
        off = float(self.scene.object_poses.log_scale.detach()) - math.log(self.lowest)
        with torch.no_grad():
            for parameter in self.scene.parameters():
                parameter.add_(1.0)
        # The first steps say something else.
        return [9.0 + off] * (stage.steps // 2) + [0.1 + off * off] * (stage.steps - stage.steps // 2)


@pytest.mark.parametrize(
    ("size", "trials"), [(1.0, 3), (1.01, 3), (0.976, 3), (1.06, 4), (0.91, 5), (1.104, 5)]
)
def test_the_lowest_is_found(both_hands: dict[Side, HandModel], size: float, trials: int) -> None:
    scene = cube_scene(both_hands, 1.0)
    with torch.no_grad():
        scene.object_poses.log_scale.fill_(0.2)
    before = {name: value.clone() for name, value in scene.state_dict().items()}
    run = Bowl(scene, size * math.exp(0.2))
    assert try_sizes(scene, STAGE, run) == pytest.approx(size, abs=1e-3)
    assert len(run.stages) == trials
    assert float(scene.object_poses.log_scale.detach()) == pytest.approx(0.2 + math.log(size), abs=1e-3)
    after = scene.state_dict()
    moved = [name for name, value in before.items() if not torch.equal(value, after[name])]
    assert set(moved) <= {"object_poses.log_scale"}


def test_a_size_far_away_is_neared(both_hands: dict[Side, HandModel]) -> None:
    scene = cube_scene(both_hands, 1.0)
    run = Bowl(scene, 2.0)
    assert try_sizes(scene, STAGE, run) == pytest.approx(1.05**3)
    assert len(run.stages) == STAGE.size_trials.most


def test_trials_are_the_stages_first_steps_at_a_fixed_size(both_hands: dict[Side, HandModel]) -> None:
    scene = cube_scene(both_hands, 1.0)
    run = Bowl(scene, 1.0)
    try_sizes(scene, STAGE, run)
    for trial in run.stages:
        assert trial.lrs == {"hand.pose": 0.01} and trial.weights == STAGE.weights
        assert (trial.steps, trial.stop_patience, trial.densify, trial.size_trials) == (6, 0, None, None)

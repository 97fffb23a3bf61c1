"""When a stage stops before its steps are done."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from toy_stages import ALONE, TOGETHER

from bigs.models.scene import Scene
from bigs.train.loop.run_stage import StageState, _advance, _has_settled, run_stage
from bigs.train.loop.step import Evidence


def test_all_steps_without_a_stopping_rule(scene: Scene, evidence: Evidence) -> None:
    state = run_stage(scene, replace(ALONE, steps=12, lrs={"hand.ray": 1e-9}), evidence, 0)
    assert state.step == 12


def test_stops_when_the_loss_has_settled(scene: Scene, evidence: Evidence) -> None:
    still = replace(TOGETHER, steps=40, lrs={"hand.ray": 1e-9}, weights={"silhouette": 1.0}, stop_patience=5)
    still = replace(still, frames_per_step=0)
    state = run_stage(scene, still, evidence, 0)
    # Two times five steps say the same, and the next is not taken.
    assert state.step == 10
    assert run_stage(scene, replace(still, stop_patience=0), evidence, 0).step == 40


def test_goes_on_while_the_loss_falls(scene: Scene, evidence: Evidence) -> None:
    with torch.no_grad():
        for poses in scene.hand_poses.values():
            poses.pose.fill_(0.5)
    falling = replace(
        TOGETHER,
        steps=25,
        lrs={"hand.pose": 1e-2},
        weights={"pose_prior": 1.0},
        frames_per_step=0,
        stop_patience=2,
    )
    assert run_stage(scene, falling, evidence, 0).step == 25


def test_a_rise_from_a_good_start_is_no_end() -> None:
    """Adam's first steps may lead away from a good start; the rule waits for what comes after."""
    losses = [0.5, 0.9, 1.0, *(0.4 + 0.6 * 0.8**i for i in range(40))]
    stage = replace(ALONE, steps=len(losses), stop_patience=4, stop_gain=0.01)
    state = StageState.begun(0, None)
    for loss in losses:
        if _has_settled(stage, state):
            break
        state = _advance(stage, state, loss)
    assert 20 < state.step < 35
    assert losses[state.step] == pytest.approx(0.4, abs=0.005)

"""The profile of a run: its parts add up, it changes nothing, and nothing of it stays behind."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.models.posed_scene import PosedScene
from bigs.models.scene import Scene
from bigs.train.fit import fit
from bigs.train.loop import step, terms
from bigs.train.loop.profile import PHASES, Profile, profiled
from bigs.train.plan.config import OptimizeStage, RunConfig
from bigs.train.plan.presets import PRESETS
from bigs.types import Side


def short(config: RunConfig, *names: str) -> RunConfig:
    stages = (stage for stage in config.stages if stage.name in names and isinstance(stage, OptimizeStage))
    return replace(config, stages=tuple(replace(stage, steps=3) for stage in stages))


class Clock:
    """Stands for the module `time`: goes on only when told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def perf_counter(self) -> float:
        return self.now

    def process_time(self) -> float:
        return 2.0 * self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr("bigs.train.loop.profile.time", clock)
    return clock


def test_phases_within_phases_are_not_counted_twice(clock: Clock) -> None:
    profile = Profile()
    profile.begin("a")
    with profile.phase("losses"):
        clock.now += 2.0
        with profile.phase("engine"):
            clock.now += 5.0
        clock.now += 1.0
    profile.finish()
    phases = profile.stages["a"].phases
    assert (phases["losses"], phases["engine"]) == (3.0, 5.0)


def test_a_backward_pass_ends_in_the_fields(clock: Clock) -> None:
    profile = Profile()
    profile.begin("a")
    with profile.phase("posing and losses backward"):
        clock.now += 1.0
        with profile.phase("engine backward"):
            clock.now += 2.0
        clock.now += 4.0
        profile.reached_fields(torch.zeros(()))
        clock.now += 8.0
        profile.reached_fields(torch.zeros(()))
        clock.now += 16.0
    profile.finish()
    phases = profile.stages["a"].phases
    assert phases["posing and losses backward"] == 5.0
    assert phases["fields backward"] == 24.0


def test_a_stage_lasts_until_the_next(clock: Clock) -> None:
    profile = Profile()
    profile.begin("start values")
    clock.now += 1.0
    profile.listen({"event": "stage", "stage": "one"})
    for _ in range(2):
        clock.now += 3.0
        profile.listen({"event": "step", "stage": "one", "seconds": 2.5})
    profile.listen({"event": "note", "stage": "outputs", "text": ""})
    profile.finish()
    one = profile.stages["one"]
    assert {name: stage.wall for name, stage in profile.stages.items() if name != "start values"} == {
        "one": 6.0,
        "outputs": 0.0,
    }
    assert (one.steps, one.in_steps, one.cpu, one.rest) == (2, 5.0, 12.0, 6.0)


def test_a_pause_counts_nowhere(clock: Clock) -> None:
    profile = Profile()
    profile.begin("a")
    clock.now += 2.0
    with profile.paused(), profile.phase("engine"):
        clock.now += 100.0
    clock.now += 1.0
    wall, cpu = profile.spent()
    profile.begin("b")
    stage = profile.stages["a"]
    assert (stage.wall, stage.cpu, stage.phases["engine"]) == (3.0, 6.0, 0.0)
    # What was before the first stage was begun counts, as it does in a run.
    assert list(profile.stages) == ["a", "b"] and (wall, cpu) == (3.0, 6.0)


def test_a_run_in_a_profile(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    config = short(PRESETS["smoke"], "hands-coarse", "joint")
    before = (PosedScene.posed, Scene.canonical, dict(terms.TERMS), torch.Tensor.backward, step.rasterization)
    plain, _ = fit(tiny, both_hands, config)
    with profiled() as profile:
        timed, _ = fit(tiny, both_hands, config, listen=profile.listen)
    after = (PosedScene.posed, Scene.canonical, dict(terms.TERMS), torch.Tensor.backward, step.rasterization)
    assert after == before

    for (name, one), (_, other) in zip(plain.state_dict().items(), timed.state_dict().items(), strict=True):
        assert torch.equal(one, other), name
    coarse, joint = profile.stages["hands-coarse"], profile.stages["joint"]
    assert (coarse.steps, joint.steps) == (3, 3)
    assert all(joint.phases[phase] > 0 for phase in PHASES)
    # Poses by silhouettes need no field.
    assert coarse.phases["fields backward"] == 0
    assert coarse.phases["engine backward"] > 0
    for stage in (coarse, joint):
        assert 0 < sum(stage.phases.values()) <= stage.wall

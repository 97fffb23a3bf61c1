"""Plans of fewer steps."""

from __future__ import annotations

from dataclasses import replace

from bigs.train.plan.length import planned_steps, shortened
from bigs.train.plan.presets import PRESETS


def test_steps_are_shared_out_as_they_were() -> None:
    paper = PRESETS["paper"]
    assert planned_steps(paper) == {"hands": 15_000, "object": 30_000, "translations": 30_000}
    short = shortened(paper, 750)
    assert planned_steps(short) == {"hands": 150, "object": 300, "translations": 300}
    assert planned_steps(shortened(paper, 1)) == dict.fromkeys(planned_steps(paper), 1)
    assert replace(short, stages=()) == replace(paper, stages=())


def test_a_plan_that_is_short_enough_is_left_alone() -> None:
    smoke = PRESETS["smoke"]
    assert shortened(smoke, sum(planned_steps(smoke).values())) is smoke
    assert [type(stage) for stage in shortened(smoke, 10).stages] == [type(stage) for stage in smoke.stages]

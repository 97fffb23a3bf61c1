"""The perceptual term in a fit: with a network it counts, without one the run says that it is off."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from small_vgg import small_network

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.train.fit import fit
from bigs.train.plan.config import RunConfig
from bigs.train.plan.presets import SMOKE
from bigs.types import Side


def plan(**weights: float) -> RunConfig:
    """Two steps of the smoke preset's joint stage."""
    joint = copy.deepcopy(next(stage for stage in SMOKE.stages if stage.name == "joint"))
    return replace(SMOKE, stages=(replace(joint, steps=2, image_size=40, weights=weights),))


def run(tiny: Clip, hands: dict[Side, HandModel], config: RunConfig, **options: Any) -> tuple[Any, Any, list]:
    events: list[dict[str, Any]] = []
    scene, report = fit(tiny, hands, config, listen=events.append, **options)
    return scene.state_dict(), report, events


def test_without_a_network_the_run_says_so_once_and_goes_on(
    tiny: Clip, both_hands: dict[Side, HandModel]
) -> None:
    without, report, events = run(tiny, both_hands, plan(image=1.0, perceptual=1.0))
    (line,) = report.skipped
    assert line == "perceptual: off in joint; --perceptual-weights FILE with VGG-16 turns it on"
    assert [event["text"] for event in events if event["event"] == "note"] == [line]
    assert all(event["terms"].keys() == {"image"} for event in events if event["event"] == "step")
    never_asked, report, _ = run(tiny, both_hands, plan(image=1.0))
    assert report.skipped == []
    assert all(torch.equal(without[name], never_asked[name]) for name in without)


def test_a_stage_of_nothing_else_is_skipped(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    _, report, events = run(tiny, both_hands, plan(perceptual=1.0))
    assert "perceptual: off in joint" in report.skipped[0]
    assert not [event for event in events if event["event"] == "step"]


def test_with_a_network_it_counts(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    with_it, report, events = run(
        tiny, both_hands, plan(image=1.0, perceptual=1.0), perceptual=small_network()
    )
    assert report.skipped == []
    steps = [event for event in events if event["event"] == "step"]
    assert all(event["terms"]["perceptual"] > 0 for event in steps)
    without, _, _ = run(tiny, both_hands, plan(image=1.0))
    assert any(not torch.equal(with_it[name], without[name]) for name in without)


def test_a_network_that_no_stage_asks_for_is_told(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    _, report, _ = run(tiny, both_hands, plan(image=1.0), perceptual=small_network())
    assert report.skipped == [
        "perceptual: a network was given, but no stage has the term (--set stages.NAME.weights.perceptual=1)"
    ]


def test_another_network_is_another_run(
    tiny: Clip, both_hands: dict[Side, HandModel], tmp_path: Path
) -> None:
    config = plan(image=1.0, perceptual=1.0)
    first, _, _ = run(tiny, both_hands, config, perceptual=small_network(), checkpoints=tmp_path)
    moved = replace(config, perceptual_weights=("elsewhere.pth",))  # its path does not matter
    again, _, events = run(
        tiny, both_hands, moved, perceptual=small_network(), checkpoints=tmp_path, resume=True
    )
    assert [event["event"] for event in events] == ["resume"]
    assert all(torch.equal(first[name], again[name]) for name in first)
    for other in (small_network(1), None):
        with pytest.raises(InputError, match="found one of another run"):
            run(tiny, both_hands, config, perceptual=other, checkpoints=tmp_path, resume=True)

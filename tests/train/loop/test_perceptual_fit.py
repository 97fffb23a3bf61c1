"""The perceptual term: with a network it counts, without one it is left out, and the run says so."""

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
from bigs.train.resolve import resolve
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
    resolved = resolve(plan(image=1.0, perceptual=1.0))
    assert resolved.notes == ["perceptual: off in joint; --perceptual-weights FILE with VGG-16 turns it on"]
    assert resolved.config == plan(image=1.0)
    assert resolve(resolved.config) == (resolved.config, None, None)
    with pytest.raises(InputError, match="stage joint: expected a network for the term 'perceptual', found"):
        run(tiny, both_hands, plan(image=1.0, perceptual=1.0))


def test_a_stage_of_nothing_else_is_left_out() -> None:
    assert resolve(plan(perceptual=1.0)).config.stages == ()


def test_with_a_network_it_counts(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    with_it, report, events = run(
        tiny, both_hands, plan(image=1.0, perceptual=1.0), perceptual=small_network()
    )
    assert report.skipped == []
    steps = [event for event in events if event["event"] == "step"]
    assert all(event["terms"]["perceptual"] > 0 for event in steps)
    without, _, _ = run(tiny, both_hands, plan(image=1.0))
    assert any(not torch.equal(with_it[name], without[name]) for name in without)


def test_a_network_that_no_stage_asks_for_is_told() -> None:
    config = replace(plan(image=1.0), perceptual_weights=("vgg16.pth",))
    assert resolve(config).config == config
    assert resolve(config).notes == [
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
    with pytest.raises(InputError, match="found one of another run"):
        run(tiny, both_hands, config, perceptual=small_network(1), checkpoints=tmp_path, resume=True)

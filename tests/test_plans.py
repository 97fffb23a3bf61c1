"""Every preset and what may be chosen beside it, in hardly any steps."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from command_line import Answer
from safetensors.numpy import load_file
from short_plans import short
from small_vgg import torchvision_state

from bigs.commands.run.reconstruct import reconstruct
from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.train.fit import fit
from bigs.train.plan.config import CompletionStage, GuidanceStage, OptimizeStage
from bigs.train.plan.presets import PRESETS
from bigs.types import Side

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("preset", ["fast", "full", "paper"])
def test_every_preset_runs(tiny_clip: Path, tmp_path: Path, preset: str) -> None:
    """All terms, groups and choices of a preset, on small fields and few steps."""
    config = short(PRESETS[preset])
    small = PRESETS["smoke"]
    config = replace(
        config,
        hand=replace(config.hand, subdivisions=0, triplane=small.hand.triplane),
        object=replace(config.object, n_gaussians=500, triplane=small.object.triplane),
        initial=replace(config.initial, surface_resolution=40),
    )
    outcome = reconstruct(tiny_clip, tmp_path / "run", config)
    idle = GuidanceStage if config.prior.kind == "symmetry" else (CompletionStage, GuidanceStage)
    names = {stage.name for stage in config.stages if not isinstance(stage, idle)}
    assert names <= outcome.report.seconds.keys()
    written = load_file(tmp_path / "run" / "scene.safetensors")
    assert all(np.isfinite(values).all() for values in written.values())
    assert ("light" in written) == config.lighting


def test_hands_may_be_kept_apart(tiny_clip: Path, tmp_path: Path) -> None:
    config = short(PRESETS["smoke"])
    config = replace(config, hand=replace(config.hand, shared=False))
    reconstruct(tiny_clip, tmp_path / "run", config)
    written = load_file(tmp_path / "run" / "scene.safetensors")
    assert not np.array_equal(written["right.splats.colors"], written["left.splats.colors"])
    assert not np.array_equal(written["right.betas"], written["left.betas"])


def test_a_plan_follows_the_pace_of_a_clip_before_its_rate(
    tiny: Clip, both_hands: dict[Side, HandModel]
) -> None:
    hands = next(s for s in PRESETS["fast"].stages if isinstance(s, OptimizeStage))
    plan = replace(
        PRESETS["smoke"],
        stages=(replace(hands, steps=2, image_size=32),),
        hand=replace(PRESETS["smoke"].hand, subdivisions=0),
        object=replace(PRESETS["smoke"].object, n_gaussians=100),
        initial=replace(PRESETS["smoke"].initial, surface_resolution=20),
    )

    def depths(clip: Clip) -> torch.Tensor:
        scene, _ = fit(clip, both_hands, plan)
        position = scene.hand_poses["right"].position
        return position.base_log_depth + position.log_depth

    slow, usual = depths(replace(tiny, fps=10.0)), depths(tiny)
    assert torch.equal(depths(replace(tiny, pace=10.0)), slow) and not torch.equal(slow, usual)


def test_a_network_for_the_perceptual_term(
    call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path
) -> None:
    """Its file goes in by an option, and its path into the configuration."""
    weights, out = tmp_path / "vgg16.pth", tmp_path / "run"
    torch.save(torchvision_state(), weights)
    stages = [stage.name for stage in PRESETS["smoke"].stages if isinstance(stage, OptimizeStage)]
    quick = [f"--set=stages.{stage}.steps=1" for stage in stages]
    answer = call(
        *(
            "reconstruct",
            tiny_clip,
            "--preset",
            "smoke",
            "--out",
            out,
            "--perceptual-weights",
            weights,
            *quick,
        ),
        *("--set", "stages.joint.weights.perceptual=0.5"),
    )
    assert answer.code == 0, answer.err
    assert "perceptual" not in answer.out
    assert yaml.safe_load((out / "config.yaml").read_text())["config"]["perceptual_weights"] == [str(weights)]
    events = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    (joint,) = [event for event in events if event["event"] == "step" and event["stage"] == "joint"]
    assert joint["terms"]["perceptual"] > 0

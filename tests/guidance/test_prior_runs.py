"""`bigs reconstruct` with a diffusion prior, from files that the other commands make, as a user would."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import Answer, assert_refused
from procedural_meshes import write_meshes

from bigs.train.plan.config import GuidanceStage, RunConfig, SplitStage
from bigs.train.plan.config_file import save_config
from bigs.train.plan.presets import SMOKE

# The tiny clip shows all of its object: here a view is asked for nevertheless, and any change is kept.
STAGE = GuidanceStage(steps=3, views=2, image_size=32, enough=2.0, well_seen=2.0, damage=1e9, unlike=1e9)


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    """A configuration of start values and the prior, nothing else."""
    # Gaussians enough that some are hidden in every frame.
    splats = replace(SMOKE.object, n_gaussians=3000)
    config: RunConfig = replace(SMOKE, object=splats, stages=(SplitStage(parts=1), STAGE))
    save_config(tmp_path / "plan.yaml", config, {})
    return tmp_path / "plan.yaml"


def steps_of(run: Path) -> list[dict[str, object]]:
    events = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    return [event for event in events if event["event"] == "step" and event["stage"] == STAGE.name]


@pytest.mark.slow
def test_stable_diffusion_with_all_that_belongs_to_it(
    call: Callable[..., Answer],
    tiny_clip: Path,
    tiny_model: Path,
    tiny_controlnet: Path,
    plan: Path,
    tmp_path: Path,
) -> None:
    """A word is learned from the clip, and the prior uses it; without the word it is another prior."""
    token = tmp_path / "token.safetensors"
    short = ("--steps", 2, "--batch", 1, "--device", "cpu", "--controlnet", tiny_controlnet)
    fitted = call(
        "prior", "fit", tiny_clip, "--object", "bottle", "--model", tiny_model, *short, "--out", token
    )
    assert fitted.code == 0, fitted.err
    command = ["reconstruct", tiny_clip, "--config", plan, "--prior", "sd", "--prior-weights", tiny_model]
    command += ["--prior-object", "bottle", "--prior-controlnet", tiny_controlnet]
    losses = []
    for name, more in (("with", ["--prior-token", token]), ("without", [])):
        answer = call(*command, *more, "--out", tmp_path / name)
        assert answer.code == 0, answer.err
        assert "moved what was not seen by" in answer.out
        steps = steps_of(tmp_path / name)
        assert [event["step"] for event in steps] == [1, 2, 3]
        losses.append([event["loss"] for event in steps])
        assert (tmp_path / name / "gaussians" / "object.ply").exists()
    assert losses[0] != losses[1]


@pytest.mark.slow
def test_a_prior_of_ones_own(
    call: Callable[..., Answer], tiny_clip: Path, plan: Path, tmp_path: Path
) -> None:
    write_meshes(tmp_path / "meshes", 2, 0)
    prior = tmp_path / "prior.safetensors"
    short = ("--steps", 2, "--batch", 2, "--views", 4, "--width", 16, "--device", "cpu")
    trained = call("prior", "train", tmp_path / "meshes", *short, "--out", prior)
    assert trained.code == 0, trained.err
    out = tmp_path / "run"
    answer = call("reconstruct", tiny_clip, "--config", plan, "--prior-weights", prior, "--out", out)
    assert answer.code == 0, answer.err
    assert "moved what was not seen by" in answer.out and len(steps_of(out)) == 3


@pytest.mark.parametrize("component", ["unet", "vae", "text_encoder", "tokenizer", "scheduler"])
def test_a_folder_that_lacks_a_component_is_refused(
    call: Callable[..., Answer], tiny_clip: Path, tiny_model: Path, plan: Path, tmp_path: Path, component: str
) -> None:
    shutil.copytree(tiny_model, tmp_path / "model")
    shutil.rmtree(tmp_path / "model" / component)
    out = tmp_path / "run"
    answer = call(
        *("reconstruct", tiny_clip, "--config", plan, "--prior", "sd"),
        *("--prior-weights", tmp_path / "model", "--out", out),
    )
    assert_refused(answer, "model", component)
    assert not out.exists()

"""Interrupted runs that go on: to the same bytes, with every step logged once."""

from __future__ import annotations

import copy
import json
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import Answer, Run, assert_refused
from forked import KILLED, Nursery
from safetensors.numpy import load_file

from bigs.checks import InputError
from bigs.commands.folder.options import check_same_options
from bigs.commands.run.reconstruct import reconstruct, run_origin
from bigs.train.plan.config_file import save_config
from bigs.train.plan.presets import PRESETS
from bigs.train.resolve import resolve

pytestmark = pytest.mark.slow


def wait_for(log: Path, text: str, lives: Callable[[], bool]) -> None:
    while not (log.exists() and text in log.read_text()):
        assert lives(), "ended before it could be killed"
        time.sleep(0.005)


def test_killed_twice_and_resumed_it_ends_the_same(
    nursery: Nursery, finished_run: Run, tmp_path: Path
) -> None:
    """Within a stage between two checkpoints, and again in a later stage; to the same bytes."""
    out, said = tmp_path / "run", tmp_path / "said"
    # How often checkpoints are kept does not change the result.
    command = [*finished_run.command, "--set", "checkpoint_every=4", "--out", str(out), "--resume"]
    for stage, step in (("hands-coarse", 10), ("appearance", 2)):
        pid = nursery.start(*command, output=said)
        place = f'"step", "stage": "{stage}", "step": {step},'
        wait_for(out / "log.jsonl", place, lambda pid=pid: nursery.lives(pid))
        os.kill(pid, signal.SIGKILL)
        assert nursery.ended() == KILLED
        assert not (out / "scene.safetensors").exists()
    # In a process of its own: other tests may have changed this one's number of threads.
    nursery.start(*command, output=said)
    assert nursery.ended() == 0, said.read_text()
    expected, found = (load_file(folder / "scene.safetensors") for folder in (finished_run.folder, out))
    assert expected.keys() == found.keys()
    assert [key for key in expected if not np.array_equal(expected[key], found[key])] == []
    scores = [json.loads((folder / "metrics.json").read_text()) for folder in (finished_run.folder, out)]
    assert scores[0] == scores[1]
    bytes_of = [(folder / "scene.safetensors").read_bytes() for folder in (finished_run.folder, out)]
    assert bytes_of[0] == bytes_of[1]


def test_a_log_cut_short_does_not_stop_a_resume(
    call: Callable[..., Answer], finished_run: Run, tmp_path: Path
) -> None:
    """A power cut may leave half a line; every number in it will be computed again."""
    out = tmp_path / "run"
    (out / "checkpoints").mkdir(parents=True)
    for name in ("config.yaml", "checkpoints/latest.safetensors", "log.jsonl"):
        (out / name).write_bytes((finished_run.folder / name).read_bytes())
    with (out / "log.jsonl").open("a") as file:
        file.write('{"event": "step", "stage": "jo')
    answer = call(*finished_run.command[:4], "--out", out, "--resume")
    assert answer.code == 0, answer.err
    for line in (out / "log.jsonl").read_text().splitlines():
        json.loads(line)


def test_a_resumed_log_has_every_step_once(tiny_clip: Path, tmp_path: Path) -> None:
    """Steps after the last checkpoint are run again; the report's curves must not go back in time."""
    stage = replace(copy.deepcopy(PRESETS["smoke"].stages[0]), steps=6)
    config = replace(PRESETS["smoke"], stages=(stage,), checkpoint_every=2)

    def interrupt(event: dict[str, Any]) -> None:
        if event["event"] == "step" and event["step"] == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(tiny_clip, tmp_path / "run", config, listen=interrupt)
    reconstruct(tiny_clip, tmp_path / "run", config, resume=True)
    events = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [e["step"] for e in events if e["event"] == "step"] == [1, 2, 3, 4, 5, 6]


def test_before_the_first_checkpoint_options_may_change(tiny_clip: Path, tmp_path: Path) -> None:
    """What is run and what config.yaml says are one; there is nothing yet that could be lost."""
    stage = replace(copy.deepcopy(PRESETS["smoke"].stages[0]), steps=2)
    config = replace(PRESETS["smoke"], stages=(stage,))

    def interrupt(event: dict[str, Any]) -> None:
        if event["event"] == "step":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(tiny_clip, tmp_path / "run", config, listen=interrupt)
    reconstruct(tiny_clip, tmp_path / "run", replace(config, seed=3), resume=True)
    assert yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["config"]["seed"] == 3
    events = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [e["step"] for e in events if e["event"] == "step"] == [1, 2]


def test_another_option_is_named_with_both_values(
    call: Callable[..., Answer], finished_run: Run, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    (out / "checkpoints").mkdir(parents=True)
    for name in ("config.yaml", "checkpoints/latest.safetensors"):
        (out / name).write_bytes((finished_run.folder / name).read_bytes())
    command = [*finished_run.command[:4], "--out", out, "--resume"]
    answer = call(*command, "--set", "seed=7")
    assert_refused(answer, "--set seed: expected 0, as the run has it, found 7", "--config", "another --out")
    answer = call(*command, "--set", "seed=7", "--set", "stages.joint.steps=99")
    assert_refused(answer, "--set seed: expected 0", "and 1 more setting")


def test_another_preset_is_named(tmp_path: Path) -> None:
    origin = run_origin(tmp_path, None)
    smoke, fast = (resolve(PRESETS[name]).config for name in ("smoke", "fast"))
    save_config(tmp_path / "config.yaml", smoke, origin)
    check_same_options(tmp_path, smoke, origin)
    with pytest.raises(InputError, match="--preset: expected smoke, as the run has it, found fast"):
        check_same_options(tmp_path, fast, origin)
    with pytest.raises(InputError, match=r"--hand-model: expected the built-in hand, .* found .*mano"):
        check_same_options(tmp_path, smoke, run_origin(tmp_path, tmp_path / "mano"))
    with pytest.raises(InputError, match=r"expected a run of bigs 99, found one of "):
        check_same_options(tmp_path, smoke, {**origin, "bigs": "99"})


def test_files_that_have_moved_are_no_other_options(tmp_path: Path) -> None:
    origin = run_origin(tmp_path, None)
    save_config(tmp_path / "config.yaml", PRESETS["smoke"], origin)
    check_same_options(tmp_path, replace(PRESETS["smoke"], perceptual_weights=("vgg.pth",)), origin)

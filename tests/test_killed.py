"""kill -9 at any instant: the run goes on with --resume and ends in the same bytes as an undisturbed one."""

from __future__ import annotations

import json
import os
import random
import signal
import time
from pathlib import Path

import pytest
from command_line import contents
from forked import KILLED, Death, Nursery

from bigs.commands.folder.lock import only_writer
from bigs.data.synthetic import make_clip
from bigs.hand import HandModel
from bigs.types import Side

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")]

# What must be the same; the rest holds times.
RESULTS = ("scene.safetensors", "poses.npz", "gaussians/hand.ply", "meshes/object.ply", "metrics.json")
# The smoke preset in few steps, and a checkpoint every other step.
STEPS = {
    "hands-coarse": 6,
    "hands-fine": 3,
    "grasped": 3,
    "appearance": 3,
    "contact": 3,
    "regrasp": 3,
    "joint": 4,
    "detail": 3,
}
QUICK = [
    f"--set=stages.{stage}.{change}"
    for stage, n in STEPS.items()
    for change in (f"steps={n}", "image_size=40")
]
# The object's Gaussians become more after the first step of a stage and, after a checkpoint, the second.
DENSIFY = "{first: 0.3, last: 0.9, every: 0.3, threshold: 1.0e-9, floor: 1, ceiling: 900}"
QUICK.append(f"--set=stages.appearance.densify={DENSIFY}")


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory, both_hands: dict[Side, HandModel]) -> list[str]:
    folder = tmp_path_factory.mktemp("tinier") / "clip"
    clip = make_clip(folder, hand_models=both_hands, frames=5, width=80, height=60, seed=1)
    changes = [*QUICK, "--set=stages.object-scale-search.candidates=3", "--set=checkpoint_every=2"]
    return ["reconstruct", str(clip), "--preset", "smoke", *changes]


class Undisturbed:
    """A run that nobody interrupts."""

    def __init__(self, folder: Path) -> None:
        self.files = {name: (folder / name).read_bytes() for name in RESULTS}
        self.names = contents(folder).keys()
        self.skipped = [e for e in events(folder) if e["event"] == "skipped"]
        self.steps = [(e["index"], e["step"]) for e in events(folder) if e["event"] == "step"]
        self.lines = len(events(folder))


def events(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def undisturbed(
    nursery: Nursery, command: list[str], tmp_path_factory: pytest.TempPathFactory
) -> Undisturbed:
    folder = tmp_path_factory.mktemp("undisturbed")
    nursery.start(*command, "--out", folder / "run", output=folder / "said")
    assert nursery.ended() == 0, (folder / "said").read_text()
    return Undisturbed(folder / "run")


def finish(nursery: Nursery, command: list[str], out: Path, undisturbed: Undisturbed) -> None:
    """Run to the end and compare."""
    said = out.with_suffix(".txt")
    nursery.start(*command, "--out", out, "--resume", output=said)
    assert nursery.ended() == 0, said.read_text()
    assert [name for name in RESULTS if (out / name).read_bytes() != undisturbed.files[name]] == []
    assert contents(out).keys() == undisturbed.names  # no temporary file is left
    assert [(e["index"], e["step"]) for e in events(out) if e["event"] == "step"] == undisturbed.steps
    assert [e for e in events(out) if e["event"] == "skipped"] == undisturbed.skipped
    times = said.read_text().replace("\n", " ")
    assert all(f"{stage} " in times for stage in STEPS)  # of stages in earlier processes, too


def test_killed_at_random_moments(
    nursery: Nursery, command: list[str], undisturbed: Undisturbed, tmp_path: Path
) -> None:
    chance, out, log = random.Random(4), tmp_path / "run", tmp_path / "run" / "log.jsonl"
    # How far the run has come by its log, whatever the machine's speed, and then some milliseconds.
    for lines in sorted(chance.choices(range(undisturbed.lines - 3), k=5)):
        pid = nursery.start(*command, "--out", out, "--resume", output=tmp_path / "said")
        while nursery.lives(pid) and (log.read_bytes().count(b"\n") if log.exists() else 0) < lines:
            time.sleep(0.002)
        time.sleep(chance.uniform(0.0, 0.03))
        os.kill(pid, signal.SIGKILL)
        assert nursery.ended() == KILLED, (tmp_path / "said").read_text()
    finish(nursery, command, out, undisturbed)


def test_two_do_not_work_on_one_run(
    nursery: Nursery, command: list[str], undisturbed: Undisturbed, tmp_path: Path
) -> None:
    out, said = tmp_path / "run", tmp_path / "said"
    out.mkdir()
    with only_writer(out):
        nursery.start(*command, "--out", out, "--resume", output=said)
        assert nursery.ended() == 2
    assert "run: expected a run that no other process works on, found one at work" in said.read_text()
    assert list(out.iterdir()) == []


def test_killed_at_every_kind_of_rename(
    nursery: Nursery, command: list[str], undisturbed: Undisturbed, tmp_path: Path
) -> None:
    """The instants that matter most: a file is complete beside its place, or has just taken it."""
    chance, out = random.Random(5), tmp_path / "run"
    # So many renames after which a process dies, that the run reaches its outputs and dies among them.
    for attempt, count in enumerate((1, 4, 9, 3, 12, 8)):
        death = Death(count, renamed=chance.random() < 0.5)
        nursery.start(*command, "--out", out, "--resume", output=tmp_path / "said", death=death)
        assert nursery.ended() == KILLED, f"attempt {attempt}: {(tmp_path / 'said').read_text()}"
    finish(nursery, command, out, undisturbed)

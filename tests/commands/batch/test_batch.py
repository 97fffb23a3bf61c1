"""Batches without clips: what is tried again, what is kept, what is told. `reconstruct` is a stand-in."""

from __future__ import annotations

import csv
import json
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import Answer, assert_refused

from bigs.checks import InputError
from bigs.commands.batch.job import Job, Status, read_status, run_job, write_status
from bigs.commands.batch.manifest import Entry
from bigs.commands.batch.run_batch import BatchPlan, BatchResult, plan_batch, run_batch, share_threads
from bigs.commands.folder.contents import CONFIG, METRICS, SCENE, write_json
from bigs.commands.folder.lock import only_writer
from bigs.commands.run.reconstruct import run_origin
from bigs.train.plan.config import RunConfig
from bigs.train.plan.config_file import save_config
from bigs.train.plan.presets import PRESETS
from bigs.train.resolve import resolve


class Clips:
    """Stands for `reconstruct`; `ends` says how a clip's attempts end, the last one for all further."""

    def __init__(self) -> None:
        self.ends: dict[str, list[BaseException | None]] = {}
        self.calls: list[tuple[str, bool]] = []

    def __call__(
        self, clip: Path, out: Path, config: RunConfig, *, hand_model: Path | None, resume: bool, **_: Any
    ) -> None:
        self.calls.append((out.name, resume))
        save_config(out / CONFIG, resolve(config).config, run_origin(clip, hand_model))
        ends = self.ends.get(out.name, [None])
        end = ends.pop(0) if len(ends) > 1 else ends[0]
        if end is not None:
            raise end
        (out / SCENE).touch()
        write_json(out / METRICS, {"result": {"mpjpe_ra_h": 5.0, "psnr_foreground": 20.0}})


class Killed(BaseException):
    """What a fake worker dies of."""


class Inline:
    """An engine that works in this process, in order."""

    def __init__(self) -> None:
        self.ended: deque[tuple[Job, str]] = deque()
        self.closed = False

    def submit(self, job: Job) -> None:
        try:
            run_job(job)
        except Killed:
            self.ended.append((job, "its process was killed (SIGKILL)"))
        else:
            self.ended.append((job, ""))

    def next_ended(self) -> tuple[Job, str]:
        return self.ended.popleft()

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def clips(monkeypatch: pytest.MonkeyPatch) -> Clips:
    fake = Clips()
    monkeypatch.setattr("bigs.commands.batch.job.reconstruct", fake)
    monkeypatch.setattr("bigs.commands.batch.job.limit_threads", lambda threads: None)
    return fake


def plan_of(out: Path, *names: str, retries: int = 1) -> BatchPlan:
    entries = [Entry(clip=Path("/clips") / name, name=name) for name in names]
    return BatchPlan(out, tuple(plan_batch(entries, out, lambda entry: PRESETS["smoke"], None)), 1, retries)


def work(plan: BatchPlan, at_once: int = 2) -> BatchResult:
    return run_batch(plan, Inline, at_once)


def test_every_clip_is_done_once(clips: Clips, tmp_path: Path) -> None:
    result = work(plan_of(tmp_path / "out", "a", "b", "c"))
    assert clips.calls == [("a", False), ("b", False), ("c", False)]
    assert (result.failed, result.kept, result.attempts) == ({}, 0, 3)
    status = read_status(tmp_path / "out" / "a")
    assert (status.state, status.attempts, status.scores["mpjpe_ra_h"]) == ("finished", 1, 5.0)


def test_finished_clips_are_kept(clips: Clips, tmp_path: Path) -> None:
    work(plan_of(tmp_path, "a"))
    result = work(plan_of(tmp_path, "a", "b"))
    assert clips.calls == [("a", False), ("b", False)]
    assert (result.kept, result.attempts) == (1, 1)
    assert work(plan_of(tmp_path, "a", "b")).attempts == 0
    # A result that was removed is made again.
    (tmp_path / "a" / SCENE).unlink()
    assert work(plan_of(tmp_path, "a", "b")).attempts == 1


def test_failures_are_tried_again_from_where_they_were(clips: Clips, tmp_path: Path) -> None:
    clips.ends = {"a": [FloatingPointError("not finite"), None], "b": [RuntimeError("always")]}
    result = work(plan_of(tmp_path, "a", "b", "c", retries=2))
    assert clips.calls.count(("a", True)) == 1 and clips.calls.count(("a", False)) == 1
    assert [name for name, _ in clips.calls].count("b") == 3
    assert result.failed == {"b": "RuntimeError: always"}
    assert read_status(tmp_path / "a").attempts == 2
    assert "Traceback" in (tmp_path / "b" / "batch.log").read_text()
    # The next call begins to count anew.
    clips.ends = {}
    assert work(plan_of(tmp_path, "a", "b", "c")).failed == {}
    assert read_status(tmp_path / "b").attempts == 1


def test_bad_input_is_not_tried_again(clips: Clips, tmp_path: Path) -> None:
    clips.ends = {"a": [InputError("a/data.npy: expected a clip, found a cat")]}
    result = work(plan_of(tmp_path, "a", "b", retries=5))
    assert [name for name, _ in clips.calls] == ["a", "b"]
    assert result.failed == {"a": "a/data.npy: expected a clip, found a cat"}


def test_a_killed_worker_costs_one_attempt(clips: Clips, tmp_path: Path) -> None:
    clips.ends = {"a": [Killed(), None], "b": [Killed()]}
    result = work(plan_of(tmp_path, "a", "b"))
    assert result.failed == {"b": "its process was killed (SIGKILL)"}
    assert [read_status(tmp_path / name).attempts for name in "ab"] == [2, 2]
    assert result.attempts == 4


def test_a_worker_that_dies_before_it_starts_is_told(clips: Clips, tmp_path: Path) -> None:
    class Stillborn(Inline):
        def submit(self, job: Job) -> None:
            self.ended.append((job, "its worker died (no memory)"))

    result = run_batch(plan_of(tmp_path, "a"), Stillborn, 1)
    assert result.failed == {"a": "its worker died (no memory)"}
    assert read_status(tmp_path / "a").attempts == 2


def test_a_second_start_of_a_finished_job_does_nothing(clips: Clips, tmp_path: Path) -> None:
    """A scheduler may run a job twice."""
    (run,) = plan_of(tmp_path, "a").runs
    run_job(Job(run, 1, "x"))
    before = read_status(tmp_path / "a")
    run_job(Job(run, 1, "x"))
    assert len(clips.calls) == 1 and read_status(tmp_path / "a") == before


def test_the_engine_is_closed_whatever_happens(clips: Clips, tmp_path: Path) -> None:
    engine = Inline()
    clips.ends = {"a": [KeyboardInterrupt()]}
    with pytest.raises(KeyboardInterrupt):
        run_batch(plan_of(tmp_path, "a"), lambda: engine, 1)
    assert engine.closed
    # Interrupted, not failed: the next call goes on.
    clips.ends = {}
    assert work(plan_of(tmp_path, "a")).failed == {}
    assert clips.calls[-1] == ("a", True)


def test_the_summary(clips: Clips, tmp_path: Path) -> None:
    clips.ends = {"b": [InputError("b: expected <one> | found\nnone")]}
    work(plan_of(tmp_path, "a", "b"))
    (tmp_path / "a" / "report.html").touch()
    work(plan_of(tmp_path, "a", "b"))
    rows = list(csv.DictReader((tmp_path / "summary.csv").read_text().splitlines()[:2]))
    assert rows[0]["clip"] == "a" and float(rows[0]["mpjpe_ra_h"]) == 5.0 and rows[0]["state"] == "finished"
    lines = (tmp_path / "summary.md").read_text().splitlines()
    assert len(lines) == 4 and {line.count(" | ") for line in lines} == {lines[0].count(" | ")}
    page = (tmp_path / "index.html").read_text()
    assert '<a href="a/report.html">a</a>' in page
    assert "expected &lt;one&gt;" in page and 'class="failed"' in page


def test_two_batches_do_not_share_a_folder(clips: Clips, tmp_path: Path) -> None:
    with only_writer(tmp_path), pytest.raises(InputError, match="no other process works on"):
        work(plan_of(tmp_path, "a"))
    assert clips.calls == []


def test_a_status_of_another_kind_is_no_status(tmp_path: Path) -> None:
    for text in ("", "{}", '{"state": 1', json.dumps({"state": "finished"})):
        (tmp_path / "status.json").write_text(text)
        assert read_status(tmp_path) == Status()
    write_status(tmp_path, Status(state="failed", error="x"))
    assert read_status(tmp_path).error == "x"


@pytest.mark.parametrize(
    ("workers", "threads", "jobs", "shared"),
    [
        (0, 0, 9, (4, 1)),
        (0, 0, 2, (2, 2)),
        (2, 0, 9, (2, 2)),
        (0, 2, 9, (2, 2)),
        (3, 5, 9, (3, 5)),
        (0, 9, 9, (1, 9)),
    ],
)
def test_threads_are_shared_out(
    monkeypatch: pytest.MonkeyPatch, workers: int, threads: int, jobs: int, shared: tuple[int, int]
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: set(range(4)), raising=False)
    assert share_threads(workers, threads, jobs) == shared


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--retries -1", ["--retries", "found -1"]),
        ("--workers -1", ["--workers", "found -1"]),
        ("--ray-address here", ["--ray-address", "--engine ray", "found processes"]),
        ("--slurm a=b", ["--slurm", "--engine slurm", "found processes"]),
        ("--slurm-cluster local", ["--slurm-cluster", "--engine slurm", "found processes"]),
        ("--engine slurm --slurm partition", ["--slurm partition", "expected name=value"]),
        ("--set nothing=1", ["--set nothing=1", "found 'nothing'"]),
        ("--engine slurm", ["--engine slurm", "expected a cluster"]),
    ],
)
def test_options_that_cannot_be(
    call: Callable[..., Answer], tmp_path: Path, options: str, words: list[str]
) -> None:
    (tmp_path / "m.txt").write_text("clip\n")
    out = tmp_path / "out"
    answer = call("batch", tmp_path / "m.txt", "--out", out, "--preset", "smoke", *options.split())
    assert_refused(answer, *words)


def test_a_preset_that_is_none(call: Callable[..., Answer], tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text("- {clip: a, preset: turbo}\n")
    answer = call("batch", tmp_path / "m.yaml", "--out", tmp_path / "out")
    assert_refused(answer, "m.yaml", "a: preset", "smoke", "'turbo'")


def test_a_preset_beside_a_config(call: Callable[..., Answer], tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text("- {clip: a, preset: fast, config: plan.yaml}\n")
    answer = call("batch", tmp_path / "m.yaml", "--out", tmp_path / "out")
    assert_refused(answer, "m.yaml", "a: preset", "found both")


def test_another_run_in_the_folder_is_refused(
    call: Callable[..., Answer], clips: Clips, tmp_path: Path
) -> None:
    from bigs.commands.run.reconstruct import run_origin
    from bigs.train.plan.config_file import save_config

    (tmp_path / "out" / "a").mkdir(parents=True)
    save_config(
        tmp_path / "out" / "a" / CONFIG, resolve(PRESETS["fast"]).config, run_origin(tmp_path / "a", None)
    )
    (tmp_path / "m.txt").write_text("b\na\n")
    answer = call("batch", tmp_path / "m.txt", "--out", tmp_path / "out", "--preset", "smoke")
    assert_refused(answer, "config.yaml", "expected the configuration of this run")
    assert clips.calls == []

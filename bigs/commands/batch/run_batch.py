"""Many clips: planned, run by an engine, retried where that can help, and summarised."""

from __future__ import annotations

import csv
import io
import os
import uuid
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bigs.atomic import atomic_write
from bigs.checks import InputError
from bigs.commands.batch.engines import Engine
from bigs.commands.batch.job import Job, Status, is_finished, read_status, write_status
from bigs.commands.batch.manifest import Entry
from bigs.commands.clips.truth import find_ground_truth
from bigs.commands.folder.contents import PREVIEW_PICTURE, REPORT
from bigs.commands.folder.lock import only_writer
from bigs.commands.run.series import Listener, PlannedRun, check_folders
from bigs.metrics.picture import ALL_METRICS
from bigs.train.plan.config import RunConfig
from bigs.viewer.batch_page import PageRow, write_batch_page

SUMMARY_TABLE, SUMMARY_TEXT, SUMMARY_PAGE = "summary.csv", "summary.md", "index.html"

# Scores in the table, those of the paper's tables; the CSV file has all.
_SHOWN = ("mpjpe_ra_h", "cd_h_sq", "cd_icp_sq", "f10_icp", "psnr_foreground")


@dataclass(frozen=True)
class BatchPlan:
    """A batch ready to be started."""

    out: Path
    runs: tuple[PlannedRun, ...]
    threads: int = 1
    retries: int = 1  # attempts after the first


@dataclass(frozen=True)
class BatchResult:
    """How a batch ended."""

    table: list[tuple[str, ...]]  # the first row is the heading
    failed: dict[str, str]  # clip -> why
    kept: int  # clips that were already finished
    attempts: int  # attempts made by this call


def plan_batch(
    entries: Sequence[Entry], out: Path, config_of: Callable[[Entry], RunConfig], hand_model: Path | None
) -> list[PlannedRun]:
    """Plan a run for each entry; each clip is checked when its turn comes.

    Raises:
        InputError: settings that cannot be, or a folder that holds a run of another clip or configuration.
    """

    def whole(path: Path | None) -> Path | None:
        """Workers may start in another folder."""
        return None if path is None else path.resolve()

    runs = [
        PlannedRun(
            folder=out.resolve() / entry.name,
            clip=entry.clip.resolve(),
            config=config_of(entry),
            hand_model=whole(entry.hand_model or hand_model),
            ground_truth=whole(entry.gt or find_ground_truth(entry.clip)),
        )
        for entry in entries
    ]
    check_folders(runs)
    return runs


def run_batch(
    plan: BatchPlan,
    start_engine: Callable[[], Engine],
    at_once: int,
    listen: Listener = lambda text: None,
) -> BatchResult:
    """Run every unfinished clip of the plan. The summary is updated after each.

    A clip that fails, or whose worker is killed, is tried again as often as the plan says and goes on from
    its last checkpoint; one whose files are refused is not. None of them stops another.

    Args:
        plan: what to do.
        start_engine: called when there is something to do.
        at_once: how many jobs the engine is given at a time.
        listen: told what is being done.

    Raises:
        InputError: another process works on the folder, or the engine cannot be started.
    """
    plan.out.mkdir(parents=True, exist_ok=True)
    with only_writer(plan.out):
        batch = uuid.uuid4().hex
        waiting = deque(Job(run, plan.threads, batch) for run in plan.runs if not is_finished(run.folder))
        kept = len(plan.runs) - len(waiting)
        _summarise(plan)
        if waiting:
            engine = start_engine()
            try:
                _work(plan, engine, waiting, at_once, listen)
            finally:
                engine.close()
        table = _summarise(plan)
        states = [read_status(run.folder) for run in plan.runs]
        failed = {
            run.folder.name: state.error
            for run, state in zip(plan.runs, states, strict=True)
            if not is_finished(run.folder)
        }
        attempts = sum(state.attempts for state in states if state.batch == batch)
        return BatchResult(table, failed, kept, attempts)


def _work(plan: BatchPlan, engine: Engine, waiting: deque[Job], at_once: int, listen: Listener) -> None:
    running = 0
    # Also counted here, since a worker may die before it can.
    tries: Counter[str] = Counter()
    while waiting or running:
        while waiting and running < at_once:
            job = waiting.popleft()
            tries[job.name] += 1
            engine.submit(job)
            running += 1
        done = sum(is_finished(run.folder) for run in plan.runs)
        listen(f"{done} of {len(plan.runs)} clips finished, {running} at work, {len(waiting)} waiting")
        job, death = engine.next_ended()
        running -= 1
        status = read_status(job.run.folder)
        if status.state != "finished":
            if death or status.state != "failed":
                error = death or "its worker ended without a result"
                status = replace(status, state="failed", error=error, again=True, batch=job.batch)
                status = replace(status, attempts=tries[job.name])
            if status.again and tries[job.name] <= plan.retries:
                status = replace(status, state="waiting")
                waiting.append(job)
            job.run.folder.mkdir(parents=True, exist_ok=True)
            write_status(job.run.folder, status)
        listen(f"{job.name}: {status.state}" + (f", {status.error}" if status.error else ""))
        _summarise(plan)


def _summarise(plan: BatchPlan) -> list[tuple[str, ...]]:
    """Write the table as CSV and Markdown and the page; returns the table."""
    rows = [(run, read_status(run.folder)) for run in plan.runs]
    keys = [key for key in ALL_METRICS if any(key in status.scores for _, status in rows)]
    shown = [key for key in _SHOWN if key in keys]
    labels = [f"{ALL_METRICS[key].paper} ({ALL_METRICS[key].unit})" for key in shown]
    heading = ("clip", "state", "attempts", "seconds", *labels)
    table = [heading, *((_cells(run, status, shown)) for run, status in rows)]
    explained = [(*heading, "why")]
    explained += [(*cells, status.error) for cells, (_, status) in zip(table[1:], rows, strict=True)]

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["clip", "path", "state", "attempts", "seconds", *keys, "error"])
    for run, status in rows:
        scores = [repr(status.scores[key]) if key in status.scores else "" for key in keys]
        facts = [run.folder.name, str(run.clip), status.state, status.attempts, status.seconds]
        writer.writerow([*facts, *scores, status.error])
    _write(plan.out / SUMMARY_TABLE, text.getvalue())

    lines = [" | ".join(" ".join(cell.replace("|", "/").split()) for cell in row) for row in explained]
    rule = " | ".join("---" for _ in explained[0])
    _write(plan.out / SUMMARY_TEXT, "".join(f"| {line} |\n" for line in [lines[0], rule, *lines[1:]]))

    page = [
        PageRow(
            cells,
            status.state,
            report=_within(run.folder, REPORT),
            picture=_within(run.folder, PREVIEW_PICTURE),
        )
        for cells, (run, status) in zip(explained[1:], rows, strict=True)
    ]
    write_batch_page(plan.out / SUMMARY_PAGE, title=f"{len(rows)} clips", heading=explained[0], rows=page)
    return table


def _cells(run: PlannedRun, status: Status, keys: Sequence[str]) -> tuple[str, ...]:
    scores = [f"{status.scores[key]:.2f}" if key in status.scores else "-" for key in keys]
    return (run.folder.name, status.state, str(status.attempts), f"{status.seconds:.0f}", *scores)


def _within(folder: Path, name: str) -> str | None:
    """A file of a clip as the page beside the folder names it."""
    return f"{folder.name}/{name}" if (folder / name).is_file() else None


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as file:
        file.write(text.encode())


def share_threads(workers: int, threads: int, jobs: int) -> tuple[int, int]:
    """The number of jobs at once and of threads for each; 0 means as many as this machine has.

    Raises:
        InputError: a negative number.
    """
    for name, value in (("--workers", workers), ("--threads", threads)):
        if value < 0:
            raise InputError(f"{name}: expected 0 or more, found {value}")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    workers = workers or max(1, min(jobs, cores // threads if threads else cores))
    return workers, threads or max(1, cores // workers)

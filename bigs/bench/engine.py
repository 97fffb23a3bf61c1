"""The measurements of `bigs bench engine`: which calls, in which processes, how often."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch

import bigs
from bigs import _raster
from bigs.bench import truth, worker
from bigs.bench.calls import OURS, Task
from bigs.bench.curve import SETTINGS, every_pair
from bigs.bench.machine import free_memory, lower_levels, machine_facts
from bigs.bench.peers import PEERS, is_installed, version
from bigs.bench.plan import Plan, check_plan
from bigs.bench.skips import SKIPS, Skip
from bigs.bench.worker import Sample, Worker
from bigs.bench.workloads import KINDS, WorkloadSpec, make_workload

# Operations per composited pair with three channels; a multiply-add counts as two. Forward: offset 2,
# exponent 8, power of two by a polynomial of degree five 13, clamp and threshold 2, weight and transmittance
# 3, colour 6, stop rule 1. Backward: offset, exponent, power and clamp again 25, weight and transmittance 3,
# gradients of colour 6, alpha 11 and opacity 1, and five moments of the offset 11.
FLOPS_FORWARD, FLOPS_BACKWARD = 35, 57
# Number of worst pixels, and of worst Gaussians per gradient, left out in the second row of errors.
_WORST = 100

# Measurements of the peak; the largest counts, since other load can only lower it.
_PEAK_TRIES = 5


class Lane(NamedTuple):
    """A process to measure in."""

    threads: int = 1
    level: str = ""  # CPU feature level for the engine; the best one if empty


class Variant(NamedTuple):
    """One thing that is timed."""

    part: str
    label: str
    lane: Lane
    task: Task


@dataclass
class Measured:
    """A variant and what was found."""

    variant: Variant
    samples: list[Sample] = field(default_factory=list)
    spent: float = 0.0  # seconds

    def summary(self) -> dict[str, float]:
        """Medians over the samples, and the fastest sums; milliseconds."""
        names = (*Sample._fields, "cpu", "wall")
        columns = {name: [getattr(sample, name) for sample in self.samples] for name in names}
        medians = {name: statistics.median(values) for name, values in columns.items()}
        return medians | {f"fastest_{name}": min(columns[name]) for name in ("cpu", "wall")}


def measure(plan: Plan, listen: Callable[[str], None] = lambda text: None) -> dict[str, Any]:
    """Everything in the plan, as plain values that JSON can hold."""
    check_plan(plan)
    began = time.perf_counter()
    report: dict[str, Any] = {
        "machine": machine_facts(),
        "bigs": bigs.__version__,
        "torch": str(torch.__version__),
        "workloads_from": "BIGS_BENCH" if plan.workloads[0].folder else f"seed {plan.workloads[0].seed}",
        "scale": plan.workloads[0].scale,
        "repeats": plan.repeats,
        "peers": {name: _peer_state(name) for name in plan.peers if "peers" in plan.parts},
        "workloads": {},
    }
    with _workers() as lane_worker:
        report["peaks"] = {
            level or _raster.simd_level(): max(
                lane_worker(Lane(1, level)).run(_raster.fma_peak_gflops) for _ in range(_PEAK_TRIES)
            )
            for level in ("", *(lower_levels() if "levels" in plan.parts else ()))
        }
        for spec in plan.workloads:
            report["workloads"][spec.name] = _measure_workload(plan, spec, lane_worker, listen)
    report["seconds"] = time.perf_counter() - began
    return report


@contextmanager
def _workers() -> Iterator[Callable[[Lane], Worker]]:
    """A function that gives each lane its process, started when first asked for."""
    with ExitStack() as stack:
        started: dict[Lane, Worker] = {}

        def lane_worker(lane: Lane) -> Worker:
            if lane not in started:
                started[lane] = Worker(lane_environment(lane))
                stack.callback(started[lane].close)
            return started[lane]

        yield lane_worker


def lane_environment(lane: Lane) -> dict[str, str]:
    """The variables that make a process a lane."""
    threads = str(lane.threads)
    return {"RAYON_NUM_THREADS": threads, "OMP_NUM_THREADS": threads, "BIGS_RASTER_SIMD": lane.level}


def variants(plan: Plan, spec: WorkloadSpec, peers: list[str]) -> list[Variant]:
    """All that is timed on a workload, in the order in which one round goes through it."""
    base = Task(spec)
    found = [Variant("times", OURS, Lane(threads), base) for threads in plan.threads]
    if "levels" in plan.parts:
        found += [Variant("levels", level, Lane(1, level), base) for level in lower_levels()]
    if {"skips", "curve", "levels", "stages"} & set(plan.parts) and 1 not in plan.threads:
        found.append(Variant("times", OURS, Lane(), base))
    if "skips" in plan.parts:
        for skip in SKIPS:
            for label, task in (("with", skip.with_it(base)), ("without", skip.without_it(base))):
                if task != base:
                    found.append(Variant("skips", f"{skip.label}, {label}", Lane(), task))
    if "curve" in plan.parts:
        for point in SETTINGS:
            task = point.task(base)
            if task != base:
                found.append(Variant("curve", point.label, Lane(), task))
    for name in peers:
        task = replace(base, renderer=name)
        found += [Variant("peers", name, Lane(threads), task) for threads in plan.threads]
    return found


def _measure_workload(
    plan: Plan, spec: WorkloadSpec, lane_worker: Callable[[Lane], Worker], listen: Callable[[str], None]
) -> dict[str, Any]:
    base, first = Task(spec), lane_worker(Lane())
    workload = make_workload(spec)
    listen(f"{spec.name}: counting pairs")
    pairs = first.run(worker.pairs, base)
    result: dict[str, Any] = {
        "text": KINDS[spec.name].text,
        "gaussians": len(workload.gaussians["means"]),
        "width": workload.width,
        "height": workload.height,
        "pairs": pairs,
    }
    left_out = {name: _why_not(name, pairs) for name in plan.peers if "peers" in plan.parts}
    peers = [name for name, why in left_out.items() if why is None]
    measured = alternate(
        plan, variants(plan, spec, peers), lane_worker, lambda text: listen(f"{spec.name}: {text}")
    )
    rows = [_row(m, lane_worker, base, min(plan.threads)) for m in measured]
    result["times"] = rows
    listen(f"{spec.name}: errors")
    result["errors"] = _errors(base, first)
    if "curve" in plan.parts:
        listen(f"{spec.name}: errors of the curve")
        result["curve"] = _curve(base, first, rows)
    if "skips" in plan.parts:
        result["skips"] = [_skip(skip, base, first, rows) for skip in SKIPS]
    if "stages" in plan.parts:
        listen(f"{spec.name}: stages")
        result["stages"] = _stages(plan, base, first)
    if "memory" in plan.parts:
        listen(f"{spec.name}: memory")
        slow = {row["label"] for row in rows if row["wall"] > 1e3 * plan.budget}
        result["memory"] = _memory(base, [name for name in (OURS, *peers) if name not in slow])
    result["peers_left_out"] = {name: why for name, why in left_out.items() if why is not None}
    return result


def alternate(
    plan: Plan,
    chosen: list[Variant],
    lane_worker: Callable[[Lane], Worker],
    listen: Callable[[str], None] = lambda text: None,
) -> list[Measured]:
    """Time every variant once a round, so that what else the machine does falls on all of them alike.

    Round 0 warms up and does not count, unless a variant's budget ends with it.
    """
    measured = [Measured(variant) for variant in chosen]
    for turn in range(plan.repeats + 1):
        listen(f"round {turn} of {plan.repeats}")
        for m in measured:
            if m.spent > plan.budget:
                continue
            start = time.perf_counter()
            sample = lane_worker(m.variant.lane).run(worker.sample, m.variant.task)
            m.spent += time.perf_counter() - start
            if turn == 1 and m.samples:
                m.samples.clear()
            m.samples.append(sample)
    return measured


def _row(
    m: Measured, lane_worker: Callable[[Lane], Worker], base: Task, fewest_threads: int
) -> dict[str, Any]:
    variant = m.variant
    row: dict[str, Any] = {
        "part": variant.part,
        "label": variant.label,
        "threads": variant.lane.threads,
        "level": variant.lane.level or _raster.simd_level(),
        "runs": len(m.samples),
        **m.summary(),
    }
    if variant.part == "levels" or (variant.part == "peers" and variant.lane.threads == fewest_threads):
        row |= _errors_by_rule(variant.task, base, lane_worker(variant.lane))
    return row


def _exact(base: Task) -> Task:
    """The truth by the base task's own rule."""
    return replace(base, dtype="float64")


def _errors_by_rule(task: Task, base: Task, process: Worker) -> dict[str, dict[str, float]]:
    """Against float64 by the base task's own rule, and without thresholds."""
    exact, without = process.run(worker.errors, task, _exact(base), every_pair(base))
    return {"exact": exact, "every_pair": without}


def _errors(base: Task, first: Worker) -> dict[str, dict[str, float]]:
    found = {}
    for label, leave_out in {"float32 against float64": 0, f"without the worst {_WORST}": _WORST}.items():
        found[label] = first.run(worker.errors, base, _exact(base), leave_out=leave_out)[0]
    independent = truth.folder_truth(base.workload)
    if independent is not None:
        for dtype in ("float32", "float64"):
            task = replace(base, dtype=dtype)
            found[f"{dtype} against the folder's reference"] = first.run(
                worker.errors_against, task, independent
            )
    return found


def _curve(base: Task, first: Worker, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    points = []
    for point in SETTINGS:
        task = point.task(base)
        row = _row_of(rows, "curve", point.label) if task != base else _row_of(rows, "times", OURS)
        points.append(
            {
                "group": point.group,
                "label": point.label,
                "cpu": row["cpu"],
                "wall": row["wall"],
                "default": task == base,
                **_errors_by_rule(task, base, first),
            }
        )
    return points


def _skip(skip: Skip, base: Task, first: Worker, rows: list[dict[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {"label": skip.label}
    for key, task in (("with", skip.with_it(base)), ("without", skip.without_it(base))):
        found[key] = (
            _row_of(rows, "times", OURS) if task == base else _row_of(rows, "skips", f"{skip.label}, {key}")
        )
        found[f"counters_{key}"] = first.run(worker.counters, task)
    found["work"] = skip.work
    return found


def _row_of(rows: list[dict[str, Any]], part: str, label: str) -> dict[str, Any]:
    return next(r for r in rows if (r["part"], r["label"], r["threads"]) == (part, label, 1))


def _stages(plan: Plan, base: Task, first: Worker) -> dict[str, float]:
    """The engine's stages and calls, and the same calls through torch: wall milliseconds, fastest run."""
    runs: dict[str, list[float]] = {}
    for _ in range(plan.repeats):
        for name, milliseconds in first.run(worker.engine_times, base):
            runs.setdefault(name, []).append(milliseconds)
        through_torch = first.run(worker.sample, base)
        runs.setdefault("torch forward", []).append(through_torch.forward_wall)
        runs.setdefault("torch backward", []).append(through_torch.backward_wall)
    return {name: min(values) for name, values in runs.items()}


def _memory(base: Task, renderers: list[str]) -> dict[str, float]:
    found = {}
    for name in renderers:
        process = Worker(lane_environment(Lane()))
        try:
            found[name] = process.run(worker.peak_memory, replace(base, renderer=name))
        finally:
            process.close()
    return found


def _why_not(name: str, pairs: int) -> str | None:
    """Why a peer is not run on a workload; None if it is."""
    peer = PEERS[name]
    if not is_installed(name):
        return f"not installed ({peer.install})"
    needed, free = peer.bytes_per_pair * pairs, free_memory()
    if free is not None and needed > free:
        return f"needs about {needed / 2**30:.0f} GiB, {free / 2**30:.0f} GiB are free"
    return None


def _peer_state(name: str) -> dict[str, str]:
    peer = PEERS[name]
    return {
        "version": version(name) if is_installed(name) else "",
        "install": peer.install,
        "note": peer.note,
    }

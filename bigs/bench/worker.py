"""A process for each environment: threads and feature level of the engine are fixed when it starts."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from multiprocessing import get_context
from typing import NamedTuple, ParamSpec, TypeVar

import numpy as np

from bigs.bench.calls import OURS, Call, Task, cached_workload
from bigs.bench.errors import relative_errors
from bigs.bench.machine import peak_of
from bigs.bench.pairs import count_pairs
from bigs.bench.workloads import WorkloadSpec

P = ParamSpec("P")
R = TypeVar("R")

# A turn of one variant lasts about this many milliseconds.
_TURN = 40.0


class Sample(NamedTuple):
    """Times of one call in milliseconds: CPU time of all threads of the process, and wall."""

    forward_cpu: float
    forward_wall: float
    backward_cpu: float
    backward_wall: float

    @property
    def cpu(self) -> float:
        """Forward and backward."""
        return self.forward_cpu + self.backward_cpu

    @property
    def wall(self) -> float:
        """Forward and backward."""
        return self.forward_wall + self.backward_wall


class Worker:
    """Runs functions of this module in one process that stays, with `environment` on top of this one's."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
        with _environment(environment):
            self._pool.submit(os.getpid).result()

    def run(self, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """The function's result; its exceptions come back too."""
        return self._pool.submit(function, *args, **kwargs).result()

    def close(self) -> None:
        """End the process."""
        self._pool.shutdown()


@contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    before = dict(os.environ)
    os.environ.update(changes)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


_peer_results: dict[Task, dict[str, np.ndarray]] = {}


# A workload has fewer variants than this, so those of the previous one are dropped.
@lru_cache(maxsize=64)
def _call(task: Task) -> Call:
    return Call(task)


def sample(task: Task) -> Sample:
    """Time the task; one of a few milliseconds several times in a row, without the first, by their medians.

    The first call after another process had the core finds cold caches, which would be held against whatever
    comes first in a round.
    """
    call = _call(task)
    first, result = _timed(call)
    if task.renderer != OURS:
        # A peer may take minutes, so its errors come from a timed run.
        _peer_results[task] = result
    if first.wall > _TURN:
        return first
    found = [first]
    while len(found) < 4 or sum(s.wall for s in found) < _TURN:
        found.append(_timed(call)[0])
    return Sample(*(statistics.median(values) for values in zip(*found[1:], strict=True)))


def _timed(call: Call) -> tuple[Sample, dict[str, np.ndarray]]:
    start = time.process_time(), time.perf_counter()
    image = call.forward()
    middle = time.process_time(), time.perf_counter()
    gradients = call.backward(image)
    end = time.process_time(), time.perf_counter()
    forward, backward = (
        [1e3 * (b - a) for a, b in zip(*ends, strict=True)] for ends in ((start, middle), (middle, end))
    )
    return Sample(*forward, *backward), {"image": image.detach().numpy(), **gradients}


def counters(task: Task) -> dict[str, int]:
    """What the renderer counted in a forward and a backward pass."""
    call = _call(task)
    call.backward(call.forward())
    found = {name: n for name, n in call.info.items() if name.startswith("n_") and isinstance(n, int)}
    return {**found, "gradients_skipped": len(call.info["gradients_skipped"])}


def errors(task: Task, *truths: Task, leave_out: int = 0) -> list[dict[str, float]]:
    """Relative errors of one task against each of several others."""
    found = _fresh_result(task)
    return [relative_errors(_result(truth), found, leave_out) for truth in truths]


def errors_against(task: Task, truth: dict[str, np.ndarray]) -> dict[str, float]:
    """Relative errors of a task against arrays."""
    return relative_errors(truth, _fresh_result(task))


def pairs(task: Task) -> int:
    """Composited pairs of the task's workload under its settings."""
    return count_pairs(cached_workload(task.workload), task.settings)


def _fresh_result(task: Task) -> dict[str, np.ndarray]:
    if task in _peer_results:
        return _peer_results[task]
    call = _call(task)
    image = call.forward()
    return {"image": image.detach().numpy(), **call.backward(image)}


# The reference of a workload under both rules.
@lru_cache(maxsize=2)
def _result(task: Task) -> dict[str, np.ndarray]:
    return _fresh_result(task)


def engine_times(task: Task) -> list[tuple[str, float]]:
    """Wall milliseconds of the engine's stages and calls without torch, by name."""
    return _call(task).engine_times()


def peak_memory(task: Task) -> float:
    """Bytes that a forward and a backward pass take at their peak, in a worker that has done nothing yet."""
    call = _call(task)
    # The first call in a process loads and starts things, which belongs to no workload.
    smallest = Call(replace(task, workload=WorkloadSpec(task.workload.name, scale=1e-9)))
    smallest.backward(smallest.forward())
    return peak_of(lambda: call.backward(call.forward()))

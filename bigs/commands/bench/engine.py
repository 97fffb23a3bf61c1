"""Measurements that a user can repeat, written as tables, numbers and a picture."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bigs.atomic import atomic_write
from bigs.bench.chart import check_drawing, draw_curve
from bigs.bench.engine import measure
from bigs.bench.page import Table
from bigs.bench.plan import Plan, check_plan
from bigs.bench.tables import markdown, tables_of
from bigs.bench.workloads import WorkloadSpec, from_environment
from bigs.checks import InputError
from bigs.commands.folder.contents import write_json

PAGE = "engine.md"
NUMBERS = "engine.json"
PICTURE = "engine.png"


def bench_engine(
    out: Path,
    workloads: tuple[str, ...],
    *,
    seed: int,
    scale: float,
    threads: tuple[int, ...],
    parts: tuple[str, ...],
    peers: tuple[str, ...],
    repeats: int,
    budget: float,
    listen: Callable[[str], None] = lambda text: None,
) -> list[Table]:
    """Measure the engine into a folder and return the tables.

    Workloads are those of the folder that BIGS_BENCH names, or made from the seed.

    Raises:
        InputError: an option, or a folder, that cannot be used; nothing has been measured then.
    """
    folder = from_environment()
    if folder is not None and scale != 1:
        raise InputError(f"--scale: expected 1 for the workloads of BIGS_BENCH, found {scale}")
    specs = tuple(WorkloadSpec(name, seed, scale, folder) for name in workloads)
    plan = Plan(specs, threads, parts, peers, repeats, budget)
    check_plan(plan)
    if "curve" in parts:
        check_drawing("--parts curve")
    out.mkdir(parents=True, exist_ok=True)
    report = measure(plan, listen)
    tables = tables_of(report)
    write_json(out / NUMBERS, _finite(report))
    with atomic_write(out / PAGE) as file:
        file.write(markdown(report, tables).encode())
    if "curve" in parts:
        with atomic_write(out / PICTURE) as file:
            file.write(draw_curve(report))
    return tables


def _finite(value: Any) -> Any:
    """The same with None for what JSON cannot say: an error that is not a number, or infinite."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

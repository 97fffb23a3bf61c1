"""Cost of bundle adjustment against points, frames, and how many frames see a point."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import bigs
from bigs.atomic import atomic_write
from bigs.bench.machine import machine_facts
from bigs.bench.page import Rows, Table, page
from bigs.checks import InputError
from bigs.commands.folder.contents import write_json
from bigs.motion.bundle import Bundle, BundleConfig, adjust, alike

PAGE = "adjustment.md"
NUMBERS = "adjustment.json"

# A camera 70 cm from an object of ten centimetres.
_K = np.array([[900.0, 0.0, 240.0], [0.0, 900.0, 180.0], [0.0, 0.0, 1.0]])
_NOISE = 0.2  # pixels


@dataclass(frozen=True)
class AdjustmentPlan:
    """The options of `bigs bench adjustment`."""

    frames: tuple[int, ...] = (60, 300)
    points: tuple[int, ...] = (1000, 7000)
    # Number of consecutive frames that see a point; 0 is all.
    seen: tuple[int, ...] = (0, 20)
    iterations: int = 15
    seed: int = 0


def bench_adjustment(
    plan: AdjustmentPlan, out: Path, listen: Callable[[str], None] = lambda text: None
) -> list[Table]:
    """Adjust simulated objects of every size in the plan, from poses 2 degrees and 4 mm off.

    Args:
        plan: what to run; all iterations are done, however little they gain.
        out: gets `adjustment.md` and `adjustment.json`.
        listen: told what is being done.

    Raises:
        InputError: a number is too small.
    """
    for name, values, least in (
        ("--frames", plan.frames, 3),
        ("--points", plan.points, 10),
        ("--seen", plan.seen, 0),
        ("--iterations", (plan.iterations,), 1),
    ):
        if min(values, default=least) < least:
            raise InputError(f"{name}: expected {least} or more, found {min(values)}")
    out.mkdir(parents=True, exist_ok=True)
    runs = []
    for frames in plan.frames:
        for points in plan.points:
            # A longer view than the clip is all of it.
            for seen in dict.fromkeys(min(n, frames) or frames for n in plan.seen):
                listen(f"{frames} frames, {points} points, each seen in {seen}")
                runs.append(_measure(frames, points, seen, plan))
    report: dict[str, Any] = {
        "machine": machine_facts(),
        "bigs": bigs.__version__,
        "iterations": plan.iterations,
        "runs": runs,
    }
    tables = [_table(report)]
    write_json(out / NUMBERS, report)
    machine = report["machine"]
    introduction = (
        f"bigs {report['bigs']}, {machine['cpu']}, {machine['cores']} cores, load at the start "
        f"{machine['load']:.1f}. Simulated objects, {plan.iterations} iterations."
    )
    with atomic_write(out / PAGE) as file:
        file.write(page("bigs bench adjustment", introduction, tables).encode())
    return tables


def simulated(frames: int, points: int, seen: int, seed: int) -> tuple[Bundle, np.ndarray]:
    """A disturbed bundle of points that `seen` consecutive frames see, and the true rotations [T, 3, 3]."""
    rng = np.random.default_rng(seed)
    turns = np.linspace(0.0, 1.0, frames)[:, None] * np.array([0.1, 1.0, 0.2])
    rotations = Rotation.from_rotvec(turns).as_matrix()
    transl = np.tile([0.01, 0.0, 0.7], (frames, 1))
    places = rng.uniform(-0.05, 0.05, (points, 3))
    first = rng.integers(0, frames - seen + 1, points)
    point = np.repeat(np.arange(points), seen)
    frame = (first[:, None] + np.arange(seen)).ravel()
    exact = Bundle(rotations, transl, places, frame, point, np.zeros((len(frame), 2)), alike(len(frame)))
    pixels = exact.residuals(_K) + _NOISE * rng.standard_normal((len(frame), 2))
    off = Rotation.from_rotvec(np.radians(2.0) * rng.standard_normal((frames, 3))).as_matrix()
    start = exact._replace(
        rotations=off @ rotations,
        transl=transl + 0.004 * rng.standard_normal((frames, 3)),
        points=places + 0.002 * rng.standard_normal((points, 3)),
        pixels=pixels,
    )
    return start, rotations


def _measure(frames: int, points: int, seen: int, plan: AdjustmentPlan) -> dict[str, Any]:
    bundle, rotations = simulated(frames, points, seen, plan.seed)
    config = BundleConfig(iterations=plan.iterations, tolerance=0.0)
    wall, cpu = time.perf_counter(), time.process_time()
    found = adjust(bundle, _K, config)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    # Steps between frames do not depend on the object's frame.
    between = [turned[1:] @ turned[:-1].transpose(0, 2, 1) for turned in (found.rotations, rotations)]
    error = Rotation.from_matrix(between[0] @ between[1].transpose(0, 2, 1)).magnitude()
    return {
        "frames": frames,
        "points": points,
        "seen": seen,
        "observations": len(bundle.frame),
        "cpu_seconds": cpu,
        "seconds": wall,
        "step_degrees": float(np.degrees(np.median(error))),
    }


def _table(report: dict[str, Any]) -> Table:
    rows: Rows = [
        ("frames", "points", "frames that see a point", "observations", "CPU s", "wall s", "step °")
    ]
    for run in report["runs"]:
        whole = (str(run[name]) for name in ("frames", "points", "seen", "observations"))
        rows.append(
            (*whole, f"{run['cpu_seconds']:.1f}", f"{run['seconds']:.1f}", f"{run['step_degrees']:.3f}")
        )
    return Table(
        "Bundle adjustment",
        "Error of the step from frame to frame, in the median; it starts at about 3 degrees.",
        rows,
    )

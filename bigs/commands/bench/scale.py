"""Time and memory of whole runs of clips with more frames and more pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

import bigs
from bigs.atomic import atomic_write
from bigs.bench.machine import largest_so_far, machine_facts
from bigs.bench.page import Rows, Table, page
from bigs.bench.worker import Worker
from bigs.checks import InputError, check_choice
from bigs.commands.clips.convert import write_build_clip
from bigs.commands.clips.open import open_estimates
from bigs.commands.folder.contents import write_json
from bigs.commands.run.series import PlannedRun, check_folders, run_or_reuse
from bigs.data.base import Clip
from bigs.data.excerpt import excerpt, to_and_fro
from bigs.files import read_json
from bigs.hand import HandModel, load_hand_models
from bigs.train.plan.config import ObjectMotionStage, OptimizeStage
from bigs.train.plan.presets import PRESETS
from bigs.types import Side

PAGE = "scale.md"
NUMBERS = "scale.json"
# The bytes that the process of a finished run held at most.
MEMORY = "memory.json"
CLIPS = "clips"


@dataclass(frozen=True)
class ScalePlan:
    """The options of `bigs bench scale`."""

    clip: Path
    # Numbers of frames, and factors on the clip's width and height; every pair of them is a run.
    frames: tuple[int, ...] = (60, 300)
    enlarge: tuple[float, ...] = (1.0, 2.0)
    preset: str = "fast"
    hand_model: Path | None = None


def bench_scale(
    plan: ScalePlan, out: Path, listen: Callable[[str], None] = lambda text: None
) -> tuple[Table, list[str]]:
    """Run a preset on a clip played to and fro and enlarged, each run in a process of its own.

    Args:
        plan: what to run.
        out: gets `clips`, the clips made, a run folder for each, `scale.md` and `scale.json`. Finished runs
            are kept.
        listen: told what is being done.

    Returns:
        The table, and the runs that failed.

    Raises:
        InputError: bad input, or the folder holds other runs; nothing has been run then.
    """
    check_choice("--preset", plan.preset, PRESETS)
    for name, values, least in (("--frames", plan.frames, 2), ("--enlarge", plan.enlarge, 0.1)):
        if min(values, default=0) < least:
            raise InputError(f"{name}: expected {least} or more, found {min(values, default='none')}")
    hand_models = load_hand_models(plan.hand_model)
    clip = open_estimates(plan.clip, hand_models)
    if not clip.mask_paths:
        raise InputError(f"{plan.clip}: expected a clip with masks, found none")
    planned = []
    for count in plan.frames:
        for factor in plan.enlarge:
            width, height = _size(clip, factor)
            label = f"{count}-frames-{width}x{height}"
            source = write_scaled(out / CLIPS / label, clip, hand_models, count, (width, height))
            run = PlannedRun(out / label, source, PRESETS[plan.preset], plan.hand_model, None)
            planned.append((label, count, width, height, run))
    check_folders([run for *_, run in planned])

    report: dict[str, Any] = {
        "machine": machine_facts(),
        "bigs": bigs.__version__,
        "preset": plan.preset,
        "threads": torch.get_num_threads(),
        "runs": [],
    }
    for label, count, width, height, run in planned:
        listen(label)
        row: dict[str, Any] = {"run": label, "frames": count, "width": width, "height": height}
        worker = Worker({"OMP_NUM_THREADS": str(report["threads"])})
        try:
            failure = worker.run(_measure, run)
        finally:
            worker.close()
        # `run_or_reuse` reads a finished run.
        done = run_or_reuse(run) if not failure else None
        if done is None:
            row["failure"] = failure
        else:
            row["times"] = done.times
            held = run.folder / MEMORY
            # Missing if the call that ran it was interrupted right then.
            row["bytes"] = read_json(held)["bytes"] if held.exists() else None
        report["runs"].append(row)
        write_json(out / NUMBERS, report)
        table = _table(report)
        with atomic_write(out / PAGE) as file:
            file.write(page("bigs bench scale", _introduction(report), [table]).encode())
    return table, [row["run"] for row in report["runs"] if "failure" in row]


def write_scaled(
    folder: Path, clip: Clip, hand_models: dict[Side, HandModel], count: int, size: tuple[int, int]
) -> Path:
    """Write the clip played to and fro for `count` frames, at another size, as a build folder.

    Args:
        folder: where to; files of an earlier call are overwritten.
        clip: with estimates and masks.
        hand_models: those of its estimates.
        count: number of frames.
        size: (width, height) of the pictures.
    """
    longer = excerpt(clip, to_and_fro(len(clip), count))
    names = tuple(f"{t:06d}" for t in range(count))
    K = clip.K.copy()
    K[:2] *= np.divide(size, (clip.width, clip.height))[:, None]

    def resized(picture: np.ndarray, how: Image.Resampling) -> np.ndarray:
        return np.asarray(Image.fromarray(picture).resize(size, how))

    return write_build_clip(
        replace(longer, frame_names=names),
        folder,
        hand_models,
        K,
        (resized(longer.image(t), Image.Resampling.BICUBIC) for t in range(count)),
        (resized(longer.mask(t), Image.Resampling.NEAREST) for t in range(count)),
    )


def _size(clip: Clip, factor: float) -> tuple[int, int]:
    return round(factor * clip.width), round(factor * clip.height)


def _measure(run: PlannedRun) -> str:
    """Run in this process unless it is done; returns why it failed, or nothing."""
    done = run_or_reuse(run)
    if not done.failure and not done.reused:
        write_json(run.folder / MEMORY, {"bytes": largest_so_far()})
    return done.failure


def _introduction(report: dict[str, Any]) -> str:
    machine = report["machine"]
    return (
        f"bigs {report['bigs']}, preset {report['preset']}, {report['threads']} threads, {machine['cpu']}, "
        f"{machine['cores']} cores, load at the start {machine['load']:.1f}."
    )


def _table(report: dict[str, Any]) -> Table:
    rows: Rows = [
        ("frames", "size", "s", "CPU s", "start, object motion, s", "steps, s", "other, s", "peak, GiB")
    ]
    config = PRESETS[report["preset"]]
    first = {"start values"} | {s.name for s in config.stages if isinstance(s, ObjectMotionStage)}
    steps = {s.name for s in config.stages if isinstance(s, OptimizeStage)}
    for row in report["runs"]:
        about = (str(row["frames"]), f"{row['width']} x {row['height']}")
        if "failure" in row:
            rows.append((*about, row["failure"], *("",) * 5))
            continue
        stages = row["times"]["stages"]
        parts = [
            sum(s["wall"] for name, s in stages.items() if name in first),
            sum(s["wall"] for name, s in stages.items() if name in steps),
        ]
        whole = row["times"]["wall"]
        seconds = (f"{value:.0f}" for value in (whole, row["times"]["cpu"], *parts, whole - sum(parts)))
        peak = "-" if row["bytes"] is None else f"{row['bytes'] / 2**30:.1f}"
        rows.append((*about, *seconds, peak))
    return Table(
        "Frames and pixels",
        "The clip played to and fro and enlarged; each run in a process of its own, whose peak memory it is.",
        rows,
    )

"""Presets and switches over clips: time, errors, and where the time goes."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

import bigs
from bigs.atomic import atomic_write
from bigs.bench.chart import check_drawing
from bigs.bench.machine import machine_facts
from bigs.bench.page import Table, page
from bigs.bench.run_chart import Clock, draw_runs
from bigs.bench.run_tables import introduction, tables_of_runs
from bigs.checks import InputError, check_choice
from bigs.commands.bench.growth import measure, probes
from bigs.commands.clips.open import open_estimates
from bigs.commands.clips.truth import find_ground_truth
from bigs.commands.folder.contents import write_json
from bigs.commands.run.series import TIMES, PlannedRun, check_folders, run_or_reuse
from bigs.data.ground_truth import load_ground_truth
from bigs.files import read_json
from bigs.hand import load_hand_models
from bigs.train.check_plan import check_plan
from bigs.train.plan.config import RunConfig
from bigs.train.plan.config_file import to_plain
from bigs.train.plan.length import planned_steps, shortened
from bigs.train.plan.presets import PRESETS
from bigs.train.switches import without_all

PAGE = "reconstruct.md"
NUMBERS = "reconstruct.json"
PICTURE = "reconstruct.png"
GROWTH = "growth"


@dataclass(frozen=True)
class RunPlan:
    """The options of `bigs bench reconstruct`."""

    clips: tuple[Path, ...]
    presets: tuple[str, ...] = ("fast",)
    # Switches to turn off in the first preset, one run each; several joined by "+" are one run.
    without: tuple[str, ...] = ()
    # Presets with more steps are cut to about this many; 0 runs all.
    steps_limit: int = 0
    hand_model: Path | None = None
    # CPU seconds between the points of a run's curve; 0 has the ends of stages only.
    curve_every: float = 10.0
    # The seconds of the picture.
    clock: Clock = "wall"
    # Growth of the first preset on the first clip: numbers of frames, and steps of each stage (0: none).
    frames: tuple[int, ...] = (15, 30, 60)
    growth_steps: int = 6


@dataclass(frozen=True)
class Variant:
    """One configuration that every clip is run with."""

    label: str  # in tables
    folder: str
    preset: str
    off: tuple[str, ...]
    whole: RunConfig  # the configuration without the limit on steps
    config: RunConfig
    unused: tuple[str, ...]  # switches that the plan does not contain


@dataclass(frozen=True)
class RunBench:
    """The tables, and the runs that failed."""

    tables: list[Table]
    failed: list[str]


def variants(plan: RunPlan) -> list[Variant]:
    """Every preset, then the first one without each switch.

    Raises:
        InputError: a preset or a switch that is none.
    """
    chosen: list[tuple[str, tuple[str, ...]]] = [(preset, ()) for preset in dict.fromkeys(plan.presets)]
    chosen += [(plan.presets[0], tuple(name.split("+"))) for name in dict.fromkeys(plan.without)]
    found = []
    for preset, off in chosen:
        check_choice("--presets", preset, PRESETS)
        whole, unused = without_all(PRESETS[preset], off)
        config = shortened(whole, plan.steps_limit) if plan.steps_limit else whole
        check_plan(config)
        label, folder = preset, preset
        if off:
            label, folder = f"{preset} without {', '.join(off)}", f"{preset}-without-{'+'.join(off)}"
        if config != whole:
            run, full = (sum(planned_steps(c).values()) for c in (config, whole))
            label, folder = f"{label} ({run} of {full} steps)", f"{folder}-{run}-steps"
        found.append(Variant(label, folder, preset, off, whole, config, tuple(unused)))
    return found


def clip_names(clips: tuple[Path, ...]) -> list[str]:
    """The clips' names, which are those of their folders.

    Raises:
        InputError: none, or two of one name.
    """
    if not clips:
        raise InputError("CLIP: expected at least one clip, found none")
    names = [
        path.resolve().parent.name if path.resolve().name == "build" else path.resolve().name
        for path in clips
    ]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"CLIP: expected folders of different names, found {name} twice")
    return names


def bench_reconstruct(
    plan: RunPlan, out: Path, *, picture: bool = True, listen: Callable[[str], None] = lambda text: None
) -> RunBench:
    """Measure into a folder; runs of an earlier call are kept, and stay in tables and picture.

    Args:
        plan: what to run.
        out: gets CLIP/VARIANT run folders, `growth`, `reconstruct.md`, `reconstruct.json`, `reconstruct.png`.
        picture: draw the picture, which needs matplotlib.
        listen: told what is being done.

    Raises:
        InputError: bad input, or the folder holds other runs; nothing has been run then.
    """
    names = clip_names(plan.clips)
    if not plan.presets:
        raise InputError("--presets: expected at least one, found none")
    for option, value in (
        ("--steps-limit", plan.steps_limit),
        ("--growth-steps", plan.growth_steps),
        ("--curve-every", plan.curve_every),
    ):
        if not value >= 0:
            raise InputError(f"{option}: expected 0 or more, found {value}")
    if any(count < 2 for count in plan.frames):
        raise InputError(f"--frames: expected numbers of at least 2, found {min(plan.frames)}")
    if picture:
        check_drawing("--picture")
    chosen = variants(plan)
    hand_models = load_hand_models(plan.hand_model)
    opened = [open_estimates(path, hand_models) for path in plan.clips]
    clips = dict(zip(names, opened, strict=True))
    planned = []
    for name, path in zip(names, plan.clips, strict=True):
        truth = find_ground_truth(path)
        if truth is not None:
            load_ground_truth(truth)
        for variant in chosen:
            folder = out / name / variant.folder
            run = PlannedRun(folder, path, variant.config, plan.hand_model, truth, plan.curve_every)
            planned.append((name, variant, run))
    check_folders([run for _, _, run in planned])

    out.mkdir(parents=True, exist_ok=True)
    report: dict[str, Any] = {
        "machine": machine_facts(),
        "bigs": bigs.__version__,
        "torch": str(torch.__version__),
        "threads": torch.get_num_threads(),
        "clips": {
            name: {"frames": len(clip), "width": clip.width, "height": clip.height}
            for name, clip in clips.items()
        },
        "runs": [],
        "growth": [],
    }
    _add_earlier_runs(report, out, {run.folder for _, _, run in planned})
    tables: list[Table] = []
    for name, variant, run in planned:
        run.folder.parent.mkdir(exist_ok=True)
        done = run_or_reuse(run, lambda text, name=name: listen(f"{name}: {text}"))  # type: ignore[misc]
        report["runs"].append(
            {
                "clip": name,
                "folder": variant.folder,
                "label": variant.label,
                "preset": variant.preset,
                "off": variant.off,
                "nothing_of": variant.unused,
                "planned": planned_steps(variant.whole),
                "steps": planned_steps(variant.config),
                **asdict(done),
            }
        )
        tables = _write(out, report)
        if picture and not (done.reused and (out / PICTURE).exists() and run is not planned[-1][-1]):
            with atomic_write(out / PICTURE) as file:
                file.write(draw_runs(report, plan.clock))
    if plan.growth_steps:
        report["growth_of"] = {"clip": names[0], "label": plan.presets[0], "steps": plan.growth_steps}
        for probe in probes(clips[names[0]], PRESETS[plan.presets[0]], plan.frames):
            listen(f"growth: {probe.axis} {probe.value}")
            key = {
                "bigs": bigs.__version__,
                "clip": str(plan.clips[0].resolve()),
                "hand_model": None if plan.hand_model is None else str(plan.hand_model.resolve()),
                "threads": torch.get_num_threads(),
                "frames": probe.frames,
                "steps": plan.growth_steps,
                "config": json.loads(json.dumps(to_plain(probe.config))),
            }
            place = out / GROWTH / f"{probe.axis} {probe.value}.json".replace("/", "_").replace(" ", "-")
            found = _stored(place, key)
            if found is None:
                found = measure(clips[names[0]], hand_models, probe, plan.growth_steps)
                place.parent.mkdir(exist_ok=True)
                write_json(place, {"of": key, "found": found})
            report["growth"].append({"axis": probe.axis, "value": probe.value, **found})
            tables = _write(out, report)
    return RunBench(tables, [f"{r['clip']}: {r['label']}" for r in report["runs"] if r["failure"]])


def _add_earlier_runs(report: dict[str, Any], out: Path, planned: set[Path]) -> None:
    """Add finished runs of earlier calls with this version that are not `planned` now, and their clips."""
    try:
        stored = read_json(out / NUMBERS)
    except InputError:
        return
    if stored["bigs"] != bigs.__version__:
        return
    for run in stored["runs"]:
        folder = out / run["clip"] / run["folder"]
        if folder not in planned and not run["failure"] and (folder / TIMES).exists():
            report["runs"].append(run)
            report["clips"].setdefault(run["clip"], stored["clips"][run["clip"]])


def _stored(path: Path, key: dict[str, Any]) -> dict[str, Any] | None:
    """Measurements of an earlier call."""
    try:
        stored = read_json(path)
    except InputError:
        return None
    return stored["found"] if stored["of"] == key else None


def _write(out: Path, report: dict[str, Any]) -> list[Table]:
    tables = tables_of_runs(report)
    write_json(out / NUMBERS, report)
    with atomic_write(out / PAGE) as file:
        file.write(page("bigs bench reconstruct", introduction(report), tables).encode())
    return tables

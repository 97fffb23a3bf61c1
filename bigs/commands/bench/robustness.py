"""How much a reconstruction suffers from a damaged clip: `bigs bench robustness`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bigs
from bigs.atomic import atomic_write
from bigs.bench.machine import machine_facts
from bigs.bench.page import Rows, Table, page
from bigs.bench.run_tables import SCORES, mean, score
from bigs.checks import InputError, check_choice
from bigs.commands.bench.clip_damage import DAMAGES, write_damaged
from bigs.commands.bench.reconstruct import clip_names
from bigs.commands.clips.open import open_estimates
from bigs.commands.clips.truth import find_ground_truth
from bigs.commands.evaluate.runs import EvaluationPlan, evaluate_run
from bigs.commands.folder.contents import write_json
from bigs.commands.run.series import PlannedRun, check_folders, run_or_reuse
from bigs.hand import load_hand_models
from bigs.metrics.picture import ALIGNED, ALL_METRICS, NOVEL_SCALED
from bigs.train.plan.presets import PRESETS

PAGE = "robustness.md"
NUMBERS = "robustness.json"
CLEAN = "clean"
DAMAGED = "clips"

# Scores in the tables, and which of them are errors to compare with the clean clip's.
_SCORES = (*SCORES, ("novel aligned dB", f"{NOVEL_SCALED}{ALIGNED}", 2))
_ERRORS = tuple(key for _, key, _ in _SCORES if ALL_METRICS[key].better == "lower")


@dataclass(frozen=True)
class RobustnessPlan:
    """The options of `bigs bench robustness`."""

    clips: tuple[Path, ...]
    damages: tuple[str, ...] = tuple(DAMAGES)
    preset: str = "fast"
    hand_model: Path | None = None
    seed: int = 0  # seed of the random damage


@dataclass(frozen=True)
class RobustnessBench:
    """The tables, and the runs that failed."""

    tables: list[Table]
    failed: list[str]


def bench_robustness(
    plan: RobustnessPlan, out: Path, listen: Callable[[str], None] = lambda text: None
) -> RobustnessBench:
    """Reconstruct clips as they are and damaged, and score all runs against the clean clips.

    Args:
        plan: what to run.
        out: gets CLIP/clips/DAMAGE, the damaged clips; CLIP/DAMAGE, the runs, of which finished ones are
            kept; `robustness.md` and `robustness.json`.
        listen: told what is being done.

    Raises:
        InputError: a clip has no ground truth or no masks, there is no such damage or preset, or the folder
            holds other runs; nothing has been run then.
    """
    names = clip_names(plan.clips)
    check_choice("--preset", plan.preset, PRESETS)
    for damage in plan.damages:
        check_choice("--damages", damage, DAMAGES)
    hand_models = load_hand_models(plan.hand_model)
    planned: list[tuple[str, str, Path, PlannedRun]] = []
    for name, path in zip(names, plan.clips, strict=True):
        truth = find_ground_truth(path)
        if truth is None:
            raise InputError(f"{path}: expected a clip with gt.npz beside its build folder, found none")
        clip = open_estimates(path, hand_models)
        for damage in (CLEAN, *plan.damages):
            source = path
            if damage != CLEAN:
                listen(f"{name}: {DAMAGES[damage].what}")
                folder = out / name / DAMAGED / damage
                source = write_damaged(folder, clip, hand_models, DAMAGES[damage], plan.seed)
            run = PlannedRun(out / name / damage, source, PRESETS[plan.preset], plan.hand_model, truth)
            planned.append((name, damage, path, run))
    check_folders([run for *_, run in planned])

    report: dict[str, Any] = {
        "machine": machine_facts(),
        "bigs": bigs.__version__,
        "preset": plan.preset,
        "seed": plan.seed,
        "runs": [],
    }
    tables: list[Table] = []
    for name, damage, path, run in planned:
        at = f"{name}: {damage}"
        row: dict[str, Any] = {"clip": name, "damage": damage}
        done = run_or_reuse(run, lambda text, at=at: listen(f"{at}: {text}"))  # type: ignore[misc]
        if done.failure:
            row["failure"] = done.failure
        else:
            # Compare with the clean pictures, not with the damaged ones.
            found = evaluate_run(run.folder, EvaluationPlan(run.ground_truth, path), listen)
            row |= {"scores": found.scores["result"], "seconds": done.times["wall"]}
        report["runs"].append(row)
        tables = _tables(report)
        write_json(out / NUMBERS, report)
        with atomic_write(out / PAGE) as file:
            file.write(page("bigs bench robustness", _introduction(report), tables).encode())
    return RobustnessBench(tables, [f"{r['clip']}: {r['damage']}" for r in report["runs"] if "failure" in r])


def _introduction(report: dict[str, Any]) -> str:
    machine = report["machine"]
    return (
        f"bigs {report['bigs']}, preset {report['preset']}, seed {report['seed']}, {machine['cpu']}, "
        f"{machine['cores']} cores. Every run is scored on the clip as it is, its truth, pictures and masks."
    )


def _tables(report: dict[str, Any]) -> list[Table]:
    finished = [row for row in report["runs"] if "scores" in row]
    clips = list(dict.fromkeys(row["clip"] for row in finished))
    shown = "; ".join(
        f"{name}: {DAMAGES[name].what}"
        for name in dict.fromkeys(r["damage"] for r in finished)
        if name != CLEAN
    )
    note = (
        "`worst ratio` is the largest quotient of an error and the same error of the clean clip, over "
        f"{', '.join(heading for heading, key, _ in _SCORES if key in _ERRORS)}. Damages: {shown}."
    )
    tables = [Table(name, note, _rows([row for row in finished if row["clip"] == name])) for name in clips]
    if len(clips) > 1:
        whole = [d for d in dict.fromkeys(r["damage"] for r in finished)]
        means = [
            {
                "damage": damage,
                "scores": {
                    key: value
                    for _, key, _ in _SCORES
                    if (value := mean(score(r["scores"], key) for r in finished if r["damage"] == damage))
                    is not None
                },
            }
            for damage in whole
            if sum(r["damage"] == damage for r in finished) == len(clips)
        ]
        tables.insert(0, Table(f"Mean of {len(clips)} clips", note, _rows(means)))
    failures: Rows = [("clip", "damage", "why")]
    failures += [(r["clip"], r["damage"], r["failure"]) for r in report["runs"] if "failure" in r]
    return tables + ([Table("Failed", "Runs without a result.", failures)] if len(failures) > 1 else [])


def _rows(runs: list[dict[str, Any]]) -> Rows:
    """One row for each damage, with the clean clip's first."""
    rows: Rows = [("", *(heading for heading, _, _ in _SCORES), "worst ratio")]
    clean: dict[str, float] = next((run["scores"] for run in runs if run["damage"] == CLEAN), {})
    for run in runs:
        values = {key: score(run["scores"], key) for _, key, _ in _SCORES}
        ratios = [
            found / usual
            for key in _ERRORS
            if (found := values[key]) is not None and (usual := score(clean, key)) is not None and usual > 0
        ]
        cells = ("-" if values[key] is None else f"{values[key]:.{digits}f}" for _, key, digits in _SCORES)
        worst = f"{max(ratios):.2f}" if ratios and run["damage"] != CLEAN else ""
        rows.append((run["damage"], *cells, worst))
    return rows

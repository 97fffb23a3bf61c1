"""The report of `bigs bench reconstruct` as tables of text."""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from typing import Any

from bigs.bench.page import Rows, Table

Run = dict[str, Any]

# Scores in a table of runs: heading, key, digits. A key that ends in _h is the mean of both hands, or the
# only hand's.
SCORES: tuple[tuple[str, str, int], ...] = (
    ("MPJPE mm", "mpjpe_ra_h", 2),
    ("wrist mm", "wrist_h", 2),
    ("CD_h cm²", "cd_h_sq", 2),
    ("CD_o cm²", "cd_icp_sq", 2),
    ("F5 %", "f5_icp", 1),
    ("F10 %", "f10_icp", 1),
    ("F10 scaled clip %", "f10_cam", 1),
    ("PSNR dB", "psnr_foreground", 2),
)
INITIAL = "initial estimates"
# A stage that spends less than this share of the fields' largest time evaluates none.
_NO_FIELDS = 0.02


def introduction(report: dict[str, Any]) -> str:
    """Where the numbers come from."""
    machine = report["machine"]
    clips = ", ".join(
        f"{name} ({clip['frames']} frames, {clip['width']} x {clip['height']})"
        for name, clip in report["clips"].items()
    )
    return (
        f"bigs {report['bigs']}, torch {report['torch']}, {machine['cpu']} ({machine['level']}), "
        f"{machine['cores']} cores, {report['threads']} threads of torch, {machine['system']}; load at the "
        f"start {machine['load']:.1f}. Clips: {clips}."
    )


# Printed on the terminal; the page has all tables.
BRIEF = ("Time and errors", "Switches", "Failed or not timed")


def tables_of_runs(report: dict[str, Any]) -> list[Table]:
    """All tables for which there are measurements."""
    made = [_means(report), _clips(report), _stages(report), _phases(report), _switches(report)]
    made += [_along(report), _skips(report), _growth(report), _failures(report)]
    return [table for table in made if len(table.rows) > 1]


def score(scores: dict[str, float], key: str) -> float | None:
    """A score; of the only hand where there is one, None where there is none."""
    if key in scores:
        return scores[key]
    base = key.replace("_h", "_{}", 1) if "_h" in key else key
    return next((scores[k] for k in (base.format("r"), base.format("l")) if k in scores), None)


def finished(report: dict[str, Any]) -> dict[str, list[Run]]:
    """Finished runs by label."""
    found: dict[str, list[Run]] = {}
    for run in report["runs"]:
        if not run["failure"]:
            found.setdefault(run["label"], []).append(run)
    return found


def is_timed(run: Run) -> bool:
    """Whether the run's times are those of all of it."""
    return not run["times"]["resumed"]


def mean(values: Iterable[float | None]) -> float | None:
    """The mean of what there is; None of nothing."""
    known = [value for value in values if value is not None]
    return statistics.mean(known) if known else None


def whole_seconds(run: Run) -> float:
    """Wall seconds of the whole plan; those of a shortened one with its steps multiplied."""
    stages = run["times"]["stages"]
    extra = sum(
        stages[name]["in_steps"] * (planned / run["steps"][name] - 1.0)
        for name, planned in run["planned"].items()
        if name in stages
    )
    return run["times"]["wall"] + extra


def _is_short(run: Run) -> bool:
    return run["planned"] != run["steps"]


def _steps_per_second(run: Run) -> float | None:
    stages = run["times"]["stages"].values()
    seconds = sum(stage["in_steps"] for stage in stages)
    return sum(stage["steps"] for stage in stages) / seconds if seconds else None


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _time_cells(runs: list[Run]) -> tuple[str, ...]:
    timed = [run for run in runs if is_timed(run)]
    whole = mean(whole_seconds(run) for run in timed) if any(map(_is_short, timed)) else None
    return (
        _text(mean(run["times"]["wall"] for run in timed), 1),
        _text(mean(run["times"]["cpu"] for run in timed), 1),
        "" if whole is None else f"{whole:.0f}",
        _text(mean(_steps_per_second(run) for run in timed), 2),
    )


def _score_cells(scores: list[dict[str, float]]) -> tuple[str, ...]:
    return tuple(_text(mean(score(s, key) for s in scores), digits) for _, key, digits in SCORES)


_TIMES = ("wall s", "CPU s", "all steps s", "steps/s")
_HEADINGS = tuple(heading for heading, _, _ in SCORES)


def _means(report: dict[str, Any]) -> Table:
    runs = finished(report)
    columns: Rows = [("", "clips", *_TIMES, *_HEADINGS)]
    first = {run["clip"]: run for group in runs.values() for run in group if "initial" in run["scores"]}
    if first:
        cells = _score_cells([run["scores"]["initial"] for run in first.values()])
        columns.append((INITIAL, str(len(first)), *("",) * len(_TIMES), *cells))
    for label, group in runs.items():
        scores = _score_cells([run["scores"]["result"] for run in group])
        columns.append((label, str(len(group)), *_time_cells(group), *scores))
    note = (
        "Means over clips. Wall and CPU time (of all threads) are of the whole run with its outputs and "
        "scores; steps per second of the steps alone. A run of fewer steps than its plan has says so in its "
        "name; its errors are those after these steps, and 'all steps' is its wall time with the steps' part "
        "multiplied to the plan's number: computed, not measured."
    )
    return Table("Time and errors", note, _turned(columns))


def _turned(columns: Rows) -> Rows:
    """Columns as rows: a run per column fits a terminal, a score per column does not."""
    return list(zip(*columns, strict=True)) if len(columns) > 1 else []


def _clips(report: dict[str, Any]) -> Table:
    rows: Rows = [("clip", "run", *_TIMES, *_HEADINGS)]
    for clip in report["clips"] if len(report["clips"]) > 1 else ():
        runs = [run for run in report["runs"] if run["clip"] == clip and not run["failure"]]
        first = next((run["scores"]["initial"] for run in runs if "initial" in run["scores"]), None)
        if first is not None:
            rows.append((clip, INITIAL, *("",) * len(_TIMES), *_score_cells([first])))
        rows += [
            (clip, run["label"], *_time_cells([run]), *_score_cells([run["scores"]["result"]]))
            for run in runs
        ]
    return Table("Clip by clip", "As above.", rows)


def _stage_means(runs: list[Run]) -> dict[str, dict[str, Any]]:
    """Means over the timed runs that have the stage, by stage; phases among them."""
    timed = [run["times"]["stages"] for run in runs if is_timed(run)]
    found = {}
    for name in dict.fromkeys(name for stages in timed for name in stages):
        parts = [stages[name] for stages in timed if name in stages]
        found[name] = {
            key: statistics.mean(part[key] for part in parts)
            for key in ("wall", "cpu", "steps", "in_steps", "rest")
        }
        found[name]["phases"] = {
            phase: statistics.mean(part["phases"][phase] for part in parts) for phase in parts[0]["phases"]
        }
    return found


def _stages(report: dict[str, Any]) -> Table:
    rows: Rows = [("run", "stage", "wall s", "CPU s", "steps", "ms/step")]
    for label, runs in finished(report).items():
        for name, stage in _stage_means(runs).items():
            per_step = f"{1e3 * stage['in_steps'] / stage['steps']:.1f}" if stage["steps"] else ""
            steps = f"{stage['steps']:.0f}" if stage["steps"] else ""
            rows.append((label, name, f"{stage['wall']:.2f}", f"{stage['cpu']:.2f}", steps, per_step))
    note = "Means over clips. 'outputs' is files, scores, pictures and the report."
    return Table("Stages", note, rows)


def _along(report: dict[str, Any]) -> Table:
    rows: Rows = [("run", "clip", "stage", "CPU s", "wall s", *_HEADINGS)]
    for label, runs in finished(report).items():
        for run in runs:
            rows += [
                (
                    label,
                    run["clip"],
                    point["stage"],
                    f"{point['cpu']:.1f}",
                    f"{point['wall']:.1f}",
                    *_score_cells([point["scores"]]),
                )
                for point in run["curve"]
                if point["step"] is None and is_timed(run)
            ]
    note = (
        "Scores at the end of each stage, over at most 20 frames of the clip, and the seconds that the run "
        "had taken by then, without scoring. reconstruct.json has the points between, too."
    )
    return Table("Along the runs", note, rows)


def _phases(report: dict[str, Any]) -> Table:
    rows: Rows = []
    for label, runs in finished(report).items():
        for name, stage in _stage_means(runs).items():
            if stage["steps"]:
                rows.append(
                    (
                        label,
                        name,
                        *(f"{1e3 * s / stage['steps']:.1f}" for s in stage["phases"].values()),
                        f"{1e3 * stage['rest'] / stage['steps']:.1f}",
                        f"{1e3 * stage['wall'] / stage['steps']:.1f}",
                    )
                )
                heading = ("run", "stage", *stage["phases"], "rest", "sum")
    note = (
        "Milliseconds of a step, wall; the stage's time divided by its steps, so 'rest' has what happens "
        "once a stage, too: images read and shrunk, states kept, checkpoints, logs. 'fields backward' begins "
        "where the backward pass reaches what the fields gave. The clock costs some microseconds a step."
    )
    return Table("Where a step's time goes", note, [heading, *rows] if rows else [])


def _switches(report: dict[str, Any]) -> Table:
    columns: Rows = [("", "wall s", *_HEADINGS, "note")]
    runs = finished(report)
    for label, group in runs.items():
        off = group[0]["off"]
        base = next(
            (g for g in runs.values() if not g[0]["off"] and g[0]["preset"] == group[0]["preset"]), None
        )
        if not off or base is None:
            continue
        both = [(run, other) for run in group for other in base if run["clip"] == other["clip"]]
        seconds = mean(
            run["times"]["wall"] - other["times"]["wall"]
            for run, other in both
            if is_timed(run) and is_timed(other)
        )
        changes = [
            mean(
                None if now is None or before is None else now - before
                for run, other in both
                for now, before in [(score(run["scores"]["result"], k), score(other["scores"]["result"], k))]
            )
            for _, k, _ in SCORES
        ]
        absent = ", ".join(f"this plan does not contain {name}" for name in group[0]["nothing_of"])
        cells = (_change(c, digits) for c, (_, _, digits) in zip(changes, SCORES, strict=True))
        columns.append((label, _change(seconds, 1), *cells, absent))
    note = "Change against the same preset with everything, mean over clips: what a switch costs and gains."
    return Table("Switches", note, _turned(columns))


def _change(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:+.{digits}f}"


def _skips(report: dict[str, Any]) -> Table:
    rows: Rows = [("run", "clip", "what was left out", "about s")]
    for label, runs in finished(report).items():
        for run in runs:
            rows += [(label, run["clip"], text, _seconds(s)) for text, s in _saved(run)]
    note = (
        "Steps that early stopping left out count at what the stage's other steps took; fields that a stage "
        "did not evaluate at what they take forward in the stage that spends most on them. Both are "
        "computed; what a switch saves when measured stands under Switches."
    )
    return Table("Work left out", note, rows)


def _seconds(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _saved(run: Run) -> Iterable[tuple[str, float | None]]:
    stages = run["times"]["stages"]
    done = {name: stages[name] for name in run["steps"] if name in stages and stages[name]["steps"]}
    settled = {
        name: (planned - done[name]["steps"]) * done[name]["in_steps"] / done[name]["steps"]
        for name, planned in run["steps"].items()
        if name in done
    }
    for text in run["skipped"]:
        stage = text.split(":")[0]
        yield text, settled.get(stage) if is_timed(run) else None
    if not is_timed(run) or not done:
        return
    cost = {name: stage["phases"]["fields"] / stage["steps"] for name, stage in done.items()}
    dearest = max(cost, key=lambda name: cost[name])
    idle = [name for name in done if cost[name] <= _NO_FIELDS * cost[dearest]]
    if idle and cost[dearest] > 0.0:
        steps = sum(done[name]["steps"] for name in idle)
        text = (
            f"fields in {steps} steps of {', '.join(idle)}, at the {1e3 * cost[dearest]:.1f} ms of {dearest}"
        )
        yield text, steps * cost[dearest]


def _growth(report: dict[str, Any]) -> Table:
    points = report["growth"]
    if not points:
        return Table("Growth", "", [])
    stages = list(points[0]["stages"])
    rows: Rows = [("what", "value", "frames", "Gaussians", "pixels", "start s", "whole s", *stages)]
    for point in points:
        rows.append(
            (
                point["axis"],
                point["value"],
                str(point["frames"]),
                str(point["gaussians"]),
                str(point["pixels"]),
                f"{point['start']:.1f}",
                f"{point['total']:.0f}",
                *(f"{point['stages'][name]:.1f}" if name in point["stages"] else "" for name in stages),
            )
        )
    of = report["growth_of"]
    note = (
        f"{of['label']} on {of['clip']}: medians of {of['steps']} steps of each stage, in milliseconds; "
        "'whole' is what the plan's steps come to with the start values and searches, computed, without "
        "outputs. Fewer or more frames than the clip has: its first, or the clip to and fro. Gaussians and "
        "image size are given as factors on the preset's; images are never made larger than they are; pixels "
        "are those of an image of the finest stage inside the box that is rendered."
    )
    return Table("Growth", note, rows)


def _failures(report: dict[str, Any]) -> Table:
    rows: Rows = [("clip", "run", "why there is no result")]
    rows += [(run["clip"], run["label"], run["failure"]) for run in report["runs"] if run["failure"]]
    rows += [
        (
            run["clip"],
            run["label"],
            "not timed: continued after an interruption (remove its folder to time it)",
        )
        for run in report["runs"]
        if not run["failure"] and not is_timed(run)
    ]
    return Table("Failed or not timed", "", rows)

"""The report of `bigs bench engine` as tables of text, for the terminal and for Markdown alike."""

from __future__ import annotations

import math
from typing import Any

from bigs.bench.engine import FLOPS_BACKWARD, FLOPS_FORWARD
from bigs.bench.errors import COLUMNS
from bigs.bench.page import Rows, Table, page

# Columns of the table of times.
_SUMS = ("forward_cpu", "backward_cpu", "cpu", "fastest_cpu", "wall", "fastest_wall")
# Stage names of `_raster.time_engine`.
_STAGES = ("project", "bin", "composite", "composite vjp", "project vjp")


def tables_of(report: dict[str, Any]) -> list[Table]:
    """All tables for which there are measurements."""
    made = [_times(report), _levels(report), _stages(report), _memory(report), _errors(report)]
    made += [_peers(report), _skips(report), _curve(report)]
    return [table for table in made if len(table.rows) > 1]


def markdown(report: dict[str, Any], tables: list[Table]) -> str:
    """The whole report as a page."""
    machine = report["machine"]
    introduction = (
        f"bigs {report['bigs']}, torch {report['torch']}, {machine['cpu']} ({machine['level']}), "
        f"{machine['cores']} cores, {machine['system']}; load at the start {machine['load']:.1f}. "
        f"Workloads from {report['workloads_from']}, scale {report['scale']:g}. "
        f"Medians of up to {report['repeats']} alternating runs; {report['seconds']:.0f} s in all."
    )
    return page("bigs bench engine", introduction, tables)


def _ms(value: float) -> str:
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"


def _times_ours(value: float, ours: float) -> str:
    return f"{value / ours:.2f}" if value < 10 * ours else f"{value / ours:.0f}"


def _error(value: float | None) -> str:
    if value is None:
        return ""
    return "(zero)" if math.isnan(value) else f"{value:.1e}"


def _selected(workload: dict[str, Any], *parts: str) -> list[dict[str, Any]]:
    return [row for row in workload["times"] if row["part"] in parts]


def _times(report: dict[str, Any]) -> Table:
    peak = report["peaks"][report["machine"]["level"]]
    rows: Rows = [
        (
            "workload", "threads", "forward ms", "backward ms", "sum ms", "fastest", "wall ms",
            "fastest wall", "speed-up", "ns/pair", "% of peak",
        )
    ]  # fmt: skip
    for name, workload in report["workloads"].items():
        times = _selected(workload, "times")
        single = next((row["fastest_wall"] for row in times if row["threads"] == 1), None)
        for row in times:
            pairs = [_per_pair(row[key], workload) for key in ("forward_cpu", "backward_cpu")]
            rows.append(
                (
                    name,
                    str(row["threads"]),
                    *(_ms(row[key]) for key in _SUMS),
                    "" if single is None else f"{single / row['fastest_wall']:.2f}",
                    _both(pairs, ".2f"),
                    _both(_shares_of_peak(pairs, peak), ".0f"),
                )
            )
    sizes = "; ".join(
        f"{name} {w['text']}, {w['gaussians']} Gaussians, {w['width']}x{w['height']}, {w['pairs']} pairs"
        for name, w in report["workloads"].items()
    )
    note = (
        "Through torch, float32. Medians of the CPU time of all threads, and of the wall time of the sum, "
        "with the fastest run beside each; speed-up is that of the fastest walls. "
        f"Workloads: {sizes}. A pair is a composited (pixel, Gaussian); ns per pair, forward / backward, "
        f"divide the whole call by them. The peak of a thread, measured, is {peak:.0f} GFLOP/s; a pair "
        f"counts {FLOPS_FORWARD} / {FLOPS_BACKWARD} operations."
    )
    return Table("Times", note, rows)


def _levels(report: dict[str, Any]) -> Table:
    best = report["machine"]["level"]
    rows: Rows = [("workload", "level", "forward ms", "backward ms", "sum ms", "x best", "largest error")]
    for name, workload in report["workloads"].items():
        lower = _selected(workload, "levels")
        if not lower:
            continue
        top = next(row for row in _selected(workload, "times") if row["threads"] == 1)
        top = {**top, "exact": workload["errors"]["float32 against float64"]}
        for row in (top, *lower):
            known = [value for value in row["exact"].values() if not math.isnan(value)]
            rows.append(
                (
                    name,
                    row["level"],
                    *(_ms(row[key]) for key in ("forward_cpu", "backward_cpu", "cpu")),
                    f"{row['cpu'] / top['cpu']:.2f}",
                    f"{max(known):.1e}",
                )
            )
    peaks = ", ".join(f"{level} {peak:.0f}" for level, peak in report["peaks"].items())
    note = (
        f"One thread; the machine's own level is {best}. Measured peaks, GFLOP/s: {peaks}. The error is the "
        "largest of image and gradients against float64."
    )
    return Table("Instruction levels", note, rows)


def _stages(report: dict[str, Any]) -> Table:
    rows: Rows = [
        (
            "workload",
            *_STAGES,
            "kernels ns/pair",
            "kernels % of peak",
            "engine",
            "through torch",
            "torch / engine",
        )
    ]
    peak = report["peaks"][report["machine"]["level"]]
    for name, workload in report["workloads"].items():
        if "stages" in workload:
            found = workload["stages"]
            whole, engine = (found[f"{way}forward"] + found[f"{way}backward"] for way in ("torch ", ""))
            kernels = [_per_pair(found[key], workload) for key in ("composite", "composite vjp")]
            rows.append(
                (
                    name,
                    *(_ms(found[stage]) for stage in _STAGES),
                    _both(kernels, ".2f"),
                    _both(_shares_of_peak(kernels, peak), ".0f"),
                    _ms(engine),
                    _ms(whole),
                    f"{whole / engine:.2f}",
                )
            )
    note = (
        "One thread, wall milliseconds, fastest run. Stages and engine are calls of the Rust crate "
        "without numpy or torch; engine is forward and backward, where it also gives the gradient of the "
        "view matrix. Kernels are the two compositing stages: ns per pair and share of the peak, forward / "
        "backward."
    )
    return Table("Stages, and what torch adds", note, rows)


def _per_pair(milliseconds: float, workload: dict[str, Any]) -> float:
    """Nanoseconds."""
    return 1e6 * milliseconds / max(workload["pairs"], 1)


def _shares_of_peak(nanoseconds: list[float], peak: float) -> list[float]:
    """Per cent of the peak that forward and backward reach with these times a pair."""
    flops = (FLOPS_FORWARD, FLOPS_BACKWARD)
    return [100 * f / max(ns * peak, 1e-9) for f, ns in zip(flops, nanoseconds, strict=True)]


def _both(values: list[float], form: str) -> str:
    return " / ".join(format(value, form) for value in values)


def _memory(report: dict[str, Any]) -> Table:
    rows: Rows = [("workload", "renderer", "MB", "bytes per Gaussian and pixel")]
    for name, workload in report["workloads"].items():
        things = workload["gaussians"] + workload["width"] * workload["height"]
        for renderer, peak in workload.get("memory", {}).items():
            rows.append((name, renderer, f"{peak / 1e6:.0f}", f"{peak / things:.0f}"))
    note = "Peak of a forward and a backward pass, in a new process, above what it held with its inputs."
    return Table("Memory", note, rows)


def _errors(report: dict[str, Any]) -> Table:
    rows: Rows = [("workload", "what", *COLUMNS)]
    for name, workload in report["workloads"].items():
        known = dict(workload["errors"])
        for row in _selected(workload, "peers"):
            if "exact" in row:
                known[f"{row['label']} against float64"] = row["exact"]
        for what, errors in known.items():
            rows.append((name, what, *(_error(errors.get(column)) for column in COLUMNS)))
    note = (
        "Relative L2 error of the image and of each gradient. float64 is this engine in float64, by the same "
        "rules; the folder's reference is another program, which BIGS_BENCH has."
    )
    return Table("Errors", note, rows)


def _peers(report: dict[str, Any]) -> Table:
    rows: Rows = [
        (
            "workload",
            "renderer",
            "threads",
            "forward ms",
            "backward ms",
            "sum ms",
            "wall ms",
            "x bigs",
            "runs",
        )
    ]
    for name, workload in report["workloads"].items():
        if not report["peers"]:
            continue
        times = _selected(workload, "times", "peers")
        ours = {row["threads"]: row for row in times if row["part"] == "times"}
        for row in times:
            rows.append(
                (
                    name,
                    row["label"],
                    str(row["threads"]),
                    *(_ms(row[key]) for key in ("forward_cpu", "backward_cpu", "cpu", "wall")),
                    " / ".join(_times_ours(row[key], ours[row["threads"]][key]) for key in ("cpu", "wall")),
                    str(row["runs"]),
                )
            )
        for peer, why in workload["peers_left_out"].items():
            rows.append((name, f"{peer}: {why}", *("",) * (len(rows[0]) - 2)))
    notes = [
        f"{name} {state['version'] or '(not installed)'}: {state['note']}."
        for name, state in report["peers"].items()
    ]
    return Table(
        "Peers", " ".join(["CPU time and wall, alternating in the same run; x bigs by both.", *notes]), rows
    )


def _skips(report: dict[str, Any]) -> Table:
    rows: Rows = [
        ("workload", "what", "without ms", "with ms", "forward x", "backward x", "sum x", "counters")
    ]
    for name, workload in report["workloads"].items():
        for skip in workload.get("skips", ()):
            gains = [
                f"{skip['work'] * skip['without'][key] / skip['with'][key]:.2f}"
                for key in ("forward_cpu", "backward_cpu", "cpu")
            ]
            before, after = skip["counters_without"], skip["counters_with"]
            changed = [
                f"{key} {before[key]} to {after[key]}" for key in after if before.get(key) != after[key]
            ]
            rows.append(
                (
                    name,
                    skip["label"],
                    _ms(skip["work"] * skip["without"]["cpu"]),
                    _ms(skip["with"]["cpu"]),
                    *gains,
                    ", ".join(changed),
                )
            )
    note = (
        "One thread, CPU time. Unseen Gaussians are held against twice the time of the scene without them, "
        "which is what they would cost if they were worked on like the others."
    )
    return Table("Work left out", note, rows)


def _curve(report: dict[str, Any]) -> Table:
    rows: Rows = [
        ("workload", "setting", "sum ms", "image", "gradients", "image, every pair", "gradients, every pair")
    ]
    for name, workload in report["workloads"].items():
        for point in workload.get("curve", ()):
            errors = [
                f(point[rule]) for rule in ("exact", "every_pair") for f in (image_error, gradient_error)
            ]
            label = point["label"] + (" (default)" if point["default"] else "")
            rows.append((name, label, _ms(point["cpu"]), *map(_error, errors)))
    note = (
        "One thread, CPU time, float32 unless said. Relative L2 errors, of gradients the largest: first "
        "against float64 with the default thresholds (gsplat's rule), then against float64 with every pair "
        "of alpha 1e-6 and more and no stop."
    )
    return Table("Time against error", note, rows)


def image_error(errors: dict[str, float]) -> float:
    """Of the image."""
    return errors["image"]


def gradient_error(errors: dict[str, float]) -> float:
    """The largest of the gradients that are not zero."""
    return max(value for name, value in errors.items() if name != "image" and not math.isnan(value))

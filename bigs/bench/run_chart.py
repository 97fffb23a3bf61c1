"""Time against each error of `bigs bench reconstruct` as a picture; needs the extra `bench`."""

from __future__ import annotations

import importlib
from io import BytesIO
from typing import Any, Literal

from bigs.bench.chart import check_drawing
from bigs.bench.run_tables import finished, is_timed, mean, score

# Heading, key, and whether a score in percent is drawn as 100 minus it. The first row has errors that fall by
# large factors, on logarithmic axes; the others may be zero.
_PANELS = (
    ("MPJPE, mm", "mpjpe_ra_h", False),
    ("wrists after one scale, mm", "wrist_h", False),
    ("CD_h, cm²", "cd_h_sq", False),
    ("100 - F5 of the object, %", "f5_icp", True),
    ("100 - F10 in the scaled clip, %", "f10_cam", True),
    ("PSNR of the foreground, dB", "psnr_foreground", False),
)
# Which seconds of a run to draw.
Clock = Literal["wall", "cpu"]
_SECONDS: dict[Clock, str] = {"wall": "wall time of a run, s", "cpu": "CPU time of a run, all threads, s"}
_COLORS = ("#1b6ca8", "#c8553d", "#5b8c5a", "#8e6c8a", "#b8860b", "#3f3f3f", "#d081a6", "#5f9ea0")


def draw_runs(report: dict[str, Any], clock: Clock = "wall") -> bytes:
    """A PNG with a panel for each error: a line along each run, and a large mark for the mean result.

    A dot on a line is the end of a stage. A line ends before the mark, which includes writing and scoring the
    outputs. Presets are round, presets without something are crosses, and runs of fewer steps than planned
    are hollow. Dashes mark the initial estimates.

    Args:
        report: what the command measured.
        clock: the seconds of the horizontal axis.
    """
    figure_module, ticker = check_drawing("--picture"), importlib.import_module("matplotlib.ticker")
    figure = figure_module.Figure(figsize=(10.5, 6.4), dpi=100, layout="constrained")
    axes = figure.subplots(2, 3).flatten()
    runs = finished(report)
    for axis, (heading, key, inverted) in zip(axes, _PANELS, strict=True):
        axis.set_title(heading, fontsize=9)
        axis.set_xscale("log")
        scaled = [axis.xaxis]
        if axis in axes[:3]:
            axis.set_yscale("log")
            scaled.append(axis.yaxis)
        axis.minorticks_off()
        for line in scaled:
            line.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
            line.set_major_formatter(ticker.FormatStrFormatter("%g"))
        axis.grid(True, which="major", color="#dddddd", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=7)
        first = {run["clip"]: run["scores"].get("initial", {}) for group in runs.values() for run in group}
        start = mean(_shown(scores, key, inverted) for scores in first.values())
        if start is not None:
            axis.axhline(start, color="#888888", linestyle="--", linewidth=0.8, label="initial estimates")
        for index, (label, group) in enumerate(runs.items()):
            _draw_group(axis, label, group, key, inverted, _COLORS[index % len(_COLORS)], clock)
    for axis in axes[3:]:
        axis.set_xlabel(_SECONDS[clock], fontsize=8)
    # Any panel may lack a score, so the legend collects from all.
    named = {
        label: handle
        for axis in axes
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    if named:
        places = {"loc": "outside lower center", "ncols": 3, "fontsize": 8, "frameon": False}
        figure.legend(list(named.values()), list(named), **places)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _draw_group(
    axis: Any, label: str, group: list[dict[str, Any]], key: str, inverted: bool, color: str, clock: Clock
) -> None:
    timed = [run for run in group if is_timed(run)]
    for run in timed:
        _draw_line(axis, run, key, inverted, color, clock)
    points = [
        (run["times"][clock], value)
        for run in timed
        if (value := _shown(run["scores"]["result"], key, inverted)) is not None
    ]
    if not points:
        return
    marker = "X" if group[0]["off"] else "o"
    face = "none" if group[0]["planned"] != group[0]["steps"] else color
    style = {"color": color, "markerfacecolor": face, "linestyle": "none"}
    if len(points) > 1:
        axis.plot(*zip(*points, strict=True), marker, markersize=4, alpha=0.6, **style)
    middle = [mean(values) for values in zip(*points, strict=True)]
    axis.plot([middle[0]], [middle[1]], marker, markersize=8, label=label, **style)


def _draw_line(axis: Any, run: dict[str, Any], key: str, inverted: bool, color: str, clock: Clock) -> None:
    known = [
        (point[clock], value, point["step"] is None)
        for point in run["curve"]
        if (value := _shown(point["scores"], key, inverted)) is not None
    ]
    if not known:
        return
    seconds, values, ends = zip(*known, strict=True)
    dots = [index for index, end in enumerate(ends) if end]
    axis.plot(seconds, values, "-o", markevery=dots, markersize=2, linewidth=1.0, alpha=0.8, color=color)


def _shown(scores: dict[str, float], key: str, inverted: bool) -> float | None:
    value = score(scores, key)
    return 100.0 - value if inverted and value is not None else value

"""The curve of time against error as a picture; needs the extra `bench`."""

from __future__ import annotations

import importlib
import math
from io import BytesIO
from typing import Any

from bigs.bench.tables import gradient_error
from bigs.checks import InputError

# Smaller errors are drawn here: a logarithmic axis cannot show float64's 0 against itself.
_FLOOR = 1e-9
_RULES = {"exact": "float64, default thresholds", "every_pair": "float64, no thresholds"}
_COLORS = ("#1b6ca8", "#c8553d", "#5b8c5a", "#8e6c8a", "#b8860b")


def check_drawing(option: str) -> Any:
    """matplotlib.figure; raises `InputError` naming the option that asks for a picture if it is missing."""
    try:
        return importlib.import_module("matplotlib.figure")
    except ImportError:
        raise InputError(
            f"{option}: expected matplotlib for the picture, found it is not installed "
            "(pip install 'bigs[bench]')"
        ) from None


def draw_curve(report: dict[str, Any]) -> bytes:
    """A PNG of the largest gradient error over time, one column for each workload.

    Above against float64 with the default thresholds, below against float64 without any: what is exact by
    the rule that all renderers share need not be near what the rule leaves out.
    """
    figure_module, ticker = check_drawing("--parts curve"), importlib.import_module("matplotlib.ticker")
    names = [name for name, workload in report["workloads"].items() if "curve" in workload]
    figure = figure_module.Figure(figsize=(3.3 * len(names) + 1.2, 6.2), dpi=100, layout="constrained")
    axes = figure.subplots(2, len(names), squeeze=False, sharex="col", sharey="row")
    for column, name in enumerate(names):
        workload = report["workloads"][name]
        for row, rule in enumerate(_RULES):
            axis = axes[row][column]
            axis.set(xscale="log", yscale="log")
            _draw_settings(axis, workload["curve"], rule)
            _draw_peers(axis, workload, rule)
            axis.minorticks_off()
            # All times of one workload may lie between two powers of ten.
            axis.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 3)))
            axis.xaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
            axis.grid(True, which="major", color="#dddddd", linewidth=0.6)
            axis.spines[["top", "right"]].set_visible(False)
            axis.tick_params(labelsize=7)
        axes[0][column].set_title(f"{name}: {workload['text']}", fontsize=9)
        axes[1][column].set_xlabel("forward + backward, ms, one thread", fontsize=8)
    for row, text in enumerate(_RULES.values()):
        axes[row][0].set_ylabel(f"gradient error, relative L2,\nagainst {text}", fontsize=8)
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=min(len(labels), 2 * len(names)),
        fontsize=8,
        frameon=False,
    )
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _draw_settings(axis: Any, points: list[dict[str, Any]], rule: str) -> None:
    groups = list(dict.fromkeys(point["group"] for point in points))
    for color, group in zip(_COLORS, groups, strict=False):
        chosen = [point for point in points if point["group"] == group]
        times = [point["cpu"] for point in chosen]
        errors = [max(gradient_error(point[rule]), _FLOOR) for point in chosen]
        axis.plot(times, errors, "o-", color=color, markersize=3.5, linewidth=1, label=f"bigs, {group}")
        for point, time, error in zip(chosen, times, errors, strict=True):
            if not point["default"]:
                text = point["label"].removeprefix(group + " ")
                near = {"xytext": (3, 3), "textcoords": "offset points"}
                axis.annotate(text, (time, error), fontsize=6, color=color, **near)


def _draw_peers(axis: Any, workload: dict[str, Any], rule: str) -> None:
    rows = [row for row in workload["times"] if row["part"] == "peers" and rule in row]
    for marker, row in zip("s^Dv", rows, strict=False):
        error = gradient_error(row[rule])
        if math.isfinite(error):
            axis.plot(
                [row["cpu"]], [max(error, _FLOOR)], marker, color="black", markersize=6, label=row["label"]
            )

"""Settings that trade time against error."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from bigs.bench.calls import Task

# Stands for a renderer without thresholds: every pair that could show in a float32 image. With exactly 0,
# every Gaussian would cover every pixel.
_FAINTEST = 1e-6


@dataclass(frozen=True)
class Point:
    """One choice of the settings."""

    group: str  # the setting that varies; points of one group are joined in the picture
    label: str
    changes: tuple[tuple[str, Any], ...]  # of RasterSettings, or dtype

    def task(self, base: Task) -> Task:
        """The base task with these settings."""
        changes = dict(self.changes)
        dtype = changes.pop("dtype", base.dtype)
        return replace(base, dtype=dtype, settings=replace(base.settings, **changes))


def _points(setting: str, values: dict[str, Any]) -> list[Point]:
    group = setting.replace("_", " ")
    return [Point(group, f"{group} {text}", ((setting, value),)) for text, value in values.items()]


SETTINGS: tuple[Point, ...] = (
    *_points(
        "alpha_threshold",
        {"1e-4": 1e-4, "1/1024": 1 / 1024, "1/255": 1 / 255, "1/128": 1 / 128, "1/64": 1 / 64},
    ),
    *_points("min_transmittance", {"0": 0.0, "1e-5": 1e-5, "1e-4": 1e-4, "1e-3": 1e-3, "1e-2": 1e-2}),
    *_points("exp_degree", {"3": 3, "4": 4, "5": 5}),
    *_points("tile_size", {"4": 4, "8": 8, "16": 16, "32": 32}),
    *_points("dtype", {"float32": "float32", "float64": "float64"}),
)


def every_pair(base: Task) -> Task:
    """The truth without thresholds: float64, all pairs with alpha of 1e-6 and more, no stop."""
    rule = replace(base.settings, alpha_threshold=_FAINTEST, min_transmittance=0.0)
    return replace(base, dtype="float64", settings=rule)

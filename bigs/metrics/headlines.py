"""The headline scores of a run, each with a plain explanation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from bigs.metrics.picture import ALL_METRICS
from bigs.metrics.report import comparison_table


class Headline(NamedTuple):
    """A headline score."""

    keys: tuple[str, ...]  # the first key that a run has is shown
    means: str


HEADLINES = (
    Headline(
        ("mpjpe_ra_h", "mpjpe_ra_r", "mpjpe_ra_l"),
        "mean distance of the 21 hand joints from the true ones, after aligning the wrists; lower is better",
    ),
    Headline(
        ("cd_h_sq", "cd_r_sq", "cd_l_sq"),
        "distance of the object from the true one, relative to the wrist; lower is better",
    ),
    Headline(
        ("cd_icp_sq",),
        "distance of the object's shape from the true one, after alignment and scaling; lower is better",
    ),
    Headline(("f10_icp",), "F-score of the aligned shape at 10 mm; higher is better"),
    Headline(
        ("psnr_foreground",),
        "likeness of rendering and video where hands and object are; higher is better",
    ),
)


def headline_keys(
    scores: Mapping[str, Mapping[str, float]], told: Mapping[str, str] | None = None
) -> list[str]:
    """The keys of the headline scores: of each headline the first that exists or has a remark."""
    known = {key for row in scores.values() for key in row} | set(told or {})
    found = (next((key for key in headline.keys if key in known), None) for headline in HEADLINES)
    return [key for key in found if key is not None]


def headline_table(
    scores: Mapping[str, Mapping[str, float]], told: Mapping[str, str] | None = None
) -> list[tuple[str, ...]]:
    """`comparison_table` for the headlines alone."""
    metrics = {key: ALL_METRICS[key] for key in headline_keys(scores, told)}
    return comparison_table(scores, metrics, details=True, told=told)


def headline_meanings(
    scores: Mapping[str, Mapping[str, float]], told: Mapping[str, str] | None = None
) -> list[str]:
    """A line on what each of the headlines means and which direction is better."""
    keys = headline_keys(scores, told)
    return [
        f"{ALL_METRICS[key].paper}: {headline.means}"
        for headline in HEADLINES
        for key in headline.keys
        if key in keys
    ]

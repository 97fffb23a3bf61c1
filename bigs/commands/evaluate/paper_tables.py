"""Runs beside the paper's Tables 1, 2 and 4: its figures, its columns, our keys."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bigs.bench.page import Table

Scores = Mapping[str, float]
_PAPER = "paper"


class RunInput(NamedTuple):
    """What a run was made from."""

    data_set: str = ""  # ARCTIC, HO-3D or "" for anything else
    told: str = ""  # suffix of the run's name


class PaperTable(NamedTuple):
    """A table of the paper."""

    title: str
    ours: str  # the title if no run is of the paper's data
    data_sets: tuple[str, ...]
    columns: dict[str, str]  # our key -> the heading, with the unit
    rows: dict[str, tuple[float | None, ...]]  # method -> figures in the columns' order


# Figures as printed. The paper gives CD in cm² throughout (`cd_*_sq`).
TWO_HANDS = PaperTable(
    "ARCTIC, two hands (the paper's Table 1: mean of nine clips)",
    "Two hands",
    ("ARCTIC",),
    {
        "cd_l_sq": "CD_l cm²",
        "cd_r_sq": "CD_r cm²",
        "cd_icp_sq": "CD_o cm²",
        "f10_icp": "F10 %",
        "mpjpe_ra_l": "MPJPE_l mm",
        "mpjpe_ra_r": "MPJPE_r mm",
    },
    {
        "HLoc": (None, None, 4.24, 40.57, None, None),
        "HaMeR": (None, None, None, None, 27.23, 24.37),
        "HOLD": (105.92, 123.54, 2.07, 63.92, 27.13, 24.70),
        "BIGS": (46.11, 31.28, 1.28, 83.93, 24.63, 24.35),
    },
)
ONE_HAND = PaperTable(
    "HO-3D v3, right hand (the paper's Table 2: mean of 18 clips)",
    "One hand",
    ("HO-3D",),
    {"cd_r_sq": "CD_r cm²", "cd_icp_sq": "CD_o cm²", "f10_icp": "F10 %", "mpjpe_ra_r": "MPJPE_r mm"},
    {
        "full view: HOMan": (78.2, None, None, 32.0),
        "full view: iHOI": (75.8, 3.8, 41.7, 38.4),
        "full view: DiffHOI": (68.8, 4.3, 43.8, 32.3),
        "full view: HOLD": (11.3, 0.4, 96.5, 24.2),
        "full view: BIGS": (11.1, 0.3, 96.7, 23.9),
        "limited view: HOLD": (95.63, 3.39, 74.90, 24.96),
        "limited view: BIGS": (21.70, 1.24, 84.02, 24.22),
    },
)
PICTURES = PaperTable(
    "Rendering (the paper's Table 4)",
    "Rendering",
    ("ARCTIC", "HO-3D"),
    {"psnr_full": "PSNR dB", "ssim_full": "SSIM", "lpips_full": "LPIPS"},
    {
        "ARCTIC: HOLD": (12.83, 0.66, 0.32),
        "ARCTIC: BIGS": (24.87, 0.96, 0.05),
        "HO-3D: HOLD": (16.20, 0.74, 0.21),
        "HO-3D: BIGS": (24.51, 0.92, 0.07),
    },
)
_NOTES = {
    TWO_HANDS.title: "CD in the squared form. Unless the runs are of those nine clips, the paper's figures "
    "are of other clips, hands and frames, and say little about ours.",
    ONE_HAND.title: "CD in the squared form. Only runs of the same clips compare.",
    PICTURES.title: "Ours: the render against the true frame blanked outside its mask, over black, all "
    "pixels counting. The paper does not say what it masks.",
}
_ELSEWHERE = (
    "CD in the squared form. The paper's figures are means over clips of ARCTIC and HO-3D and "
    "stand only beside runs of those."
)


def beside_paper(runs: Mapping[str, Scores], inputs: Mapping[str, RunInput]) -> list[Table]:
    """The tables that the runs have scores for, with a mean where there are several runs.

    The paper's rows stand only in tables with a run of the data set that they are of.

    Args:
        runs: name -> its scores under the keys of `bigs.metrics`.
        inputs: name -> what it was made from.
    """
    two = {name: scores for name, scores in runs.items() if "mpjpe_ra_l" in scores}
    one = {name: scores for name, scores in runs.items() if "mpjpe_ra_r" in scores and name not in two}
    drawn = {name: scores for name, scores in runs.items() if "psnr_full" in scores}
    chosen = ((TWO_HANDS, two), (ONE_HAND, one), (PICTURES, drawn))
    return [_table(paper, scores, inputs) for paper, scores in chosen if scores]


def mean_scores(runs: Mapping[str, Scores]) -> dict[str, float]:
    """The plain mean over runs of each score that all of them have, as the evaluators average sequences."""
    keys = [key for key in next(iter(runs.values())) if all(key in scores for scores in runs.values())]
    return {key: float(np.mean([scores[key] for scores in runs.values()])) for key in keys}


def _table(paper: PaperTable, runs: Mapping[str, Scores], inputs: Mapping[str, RunInput]) -> Table:
    given = {name: inputs.get(name, RunInput()) for name in runs}
    known = {one.data_set for one in given.values()} & set(paper.data_sets)
    labels = {name: f"{name} ({one.told})" if one.told else name for name, one in given.items()}
    rows = {labels[name]: [scores.get(key) for key in paper.columns] for name, scores in runs.items()}
    if len(runs) > 1:
        mean = mean_scores(runs)
        rows[f"mean of {len(runs)}"] = [mean.get(key) for key in paper.columns]
    rows |= {
        f"{_PAPER}: {method}": list(figures)
        for method, figures in paper.rows.items()
        if known and (len(paper.data_sets) == 1 or method.split(":")[0] in known)
    }
    body = [(name, *map(_cell, figures)) for name, figures in rows.items()]
    note = _NOTES[paper.title] if known else _ELSEWHERE
    title = paper.title if known else paper.ours
    return Table(title, note, [("", *paper.columns.values()), *body])


def _cell(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.2f}"

"""The paper's Table 3 on a clip: the method with and without its ingredients, beside the paper's figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path

import bigs
from bigs.atomic import atomic_write
from bigs.bench.machine import machine_facts
from bigs.bench.page import Table, page
from bigs.checks import InputError, check_choice
from bigs.commands.clips.open import open_estimates
from bigs.commands.clips.truth import find_ground_truth, load_truth
from bigs.commands.folder.contents import write_json
from bigs.commands.run.series import FinishedRun, PlannedRun, check_folders, run_or_reuse
from bigs.hand import load_hand_models
from bigs.metrics.report import METRICS
from bigs.train.check_plan import check_plan
from bigs.train.plan.config import RunConfig
from bigs.train.switches import SWITCHES, without_all

PAGE = "ablation.md"
NUMBERS = "ablation.json"
FULL = "full"

# The paper's switches in the order in which its table removes them: L_SDS, L_contact, L_smt and sharing.
INGREDIENTS = ("prior", "contact", "smooth", "share")
_SCORES = ("cd_l_sq", "cd_r_sq", "cd_icp_sq", "f10_icp", "mpjpe_ra_l", "mpjpe_ra_r")
# Table 3 of the paper (nine clips of ARCTIC): what is left out, and `_SCORES`.
_PAPER: dict[frozenset[str], tuple[float, ...]] = {
    frozenset(): (46.11, 31.28, 1.28, 83.93, 24.63, 24.35),
    frozenset(INGREDIENTS[:1]): (50.78, 35.57, 1.36, 81.78, 24.63, 24.35),
    frozenset(INGREDIENTS[:2]): (83.14, 96.95, 1.36, 81.78, 24.63, 24.35),
    frozenset(INGREDIENTS[:3]): (96.55, 117.72, 1.36, 81.78, 27.01, 24.42),
    frozenset(INGREDIENTS): (96.56, 117.72, 1.36, 81.78, 27.22, 25.08),
}


@dataclass(frozen=True)
class Row:
    """One variant of the method."""

    off: tuple[str, ...]  # switches

    @property
    def name(self) -> str:
        """How it is asked for, and called in files."""
        return "+".join(self.off) or FULL

    @property
    def paper(self) -> tuple[float, ...] | None:
        """The paper's scores of this variant, if it has them."""
        return _PAPER.get(frozenset(self.off))


@dataclass(frozen=True)
class Ablation:
    """A clip's table, and the names of rows that failed."""

    table: Table
    failed: list[str]


def default_rows() -> list[str]:
    """Each of the paper's ingredients missing alone, and as the paper's table takes them away."""
    joined = ["+".join(INGREDIENTS[: n + 1]) for n in range(len(INGREDIENTS))]
    return list(dict.fromkeys([*INGREDIENTS, *joined]))


def parse_rows(names: Iterable[str]) -> list[Row]:
    """The full method, then what was asked for: switches that are off joined by "+".

    Raises:
        InputError: a switch that is none.
    """
    # The same ingredients in another order make the same row.
    rows = {frozenset[str](): Row(())}
    for name in chain.from_iterable(name.split(",") for name in names):
        off = tuple(dict.fromkeys(name.split("+"))) if name != FULL else ()
        for what in off:
            check_choice(f"--rows {name}", what, (FULL, *SWITCHES), "ingredients and loss terms")
        rows.setdefault(frozenset(off), Row(off))
    return list(rows.values())


def ablate(
    clip: Path,
    out: Path,
    config: RunConfig,
    rows: Iterable[str],
    *,
    hand_model: Path | None = None,
    ground_truth: Path | None = None,
    listen: Callable[[str], None] = lambda text: None,
) -> Ablation:
    """Run every row into a folder of its own and write the table after each.

    Args:
        clip: the clip.
        out: folder for the runs, `ablation.md` and `ablation.json`; rows that it holds are not run again.
        config: the full method.
        rows: see `parse_rows`.
        hand_model: MANO-format models; None takes the built-in hand.
        ground_truth: None takes the clip's own gt.npz.
        listen: told what is being done.

    Raises:
        InputError: bad input, or the folder holds other runs; nothing has been run then.
    """
    chosen = parse_rows(rows)
    check_plan(config)
    truth = ground_truth or find_ground_truth(clip)
    if truth is None:
        raise InputError(
            f"--gt: expected ground truth to score against, found none given and no {clip}/gt.npz"
        )
    planned, unused = {}, {}
    for row in chosen:
        less, unused[row.name] = without_all(config, row.off)
        check_plan(less)
        planned[row.name] = PlannedRun(out / row.name, clip, less, hand_model, truth)
    check_folders(list(planned.values()))
    hand_models = load_hand_models(hand_model)
    load_truth(truth, open_estimates(clip, hand_models).frame_names, hand_models)
    out.mkdir(parents=True, exist_ok=True)
    done: dict[str, FinishedRun] = {}
    for row in chosen:
        done[row.name] = run_or_reuse(planned[row.name], listen)
        table = ablation_table(chosen, done, unused)
        _write(out, clip, table, chosen, done, unused)
    return Ablation(table, [name for name, run in done.items() if run.failure])


def ablation_table(rows: list[Row], done: dict[str, FinishedRun], unused: dict[str, list[str]]) -> Table:
    """Scores of every row that was run, and below them the paper's where it has the row."""
    heading = ("without", *(f"{METRICS[key].paper} {METRICS[key].unit}" for key in _SCORES), "s")
    nothing = ("",) * (len(_SCORES) + 1)
    body: list[tuple[str, ...]] = []
    notes = [
        "The datasets differ: the paper's figures are means over nine clips of ARCTIC, ours of this clip; "
        "only the direction of a change compares. CD is squared, as in the paper. The paper's prior is "
        "diffusion; ours is symmetry where no weights are given."
    ]
    for row in rows:
        label = " + ".join(row.off) or "nothing"
        run = done.get(row.name)
        if run is not None and run.failure:
            body.append((label, *nothing))
            notes.append(f"{label} failed: {run.failure}.")
        elif run is not None:
            resumed = run.times["resumed"]
            seconds = "-" if resumed else f"{run.times['wall']:.0f}"
            body.append((label, *(_score(run.scores["result"], key) for key in _SCORES), seconds))
            notes += [f"{label}: continued after an interruption, not timed."] if resumed else []
            notes += [f"{label}: this plan does not contain {name}." for name in unused[row.name]]
        if row.paper is not None:
            body.append(_paper_cells(row.paper))
    initial = next((run.scores["initial"] for run in done.values() if "initial" in run.scores), None)
    if initial is not None:
        body.append(("initial estimates", *(_score(initial, key) for key in _SCORES), ""))
    return Table("Ablation", " ".join(notes), [heading, *body])


def _paper_cells(scores: tuple[float, ...]) -> tuple[str, ...]:
    return ("(the paper)", *map("{:.2f}".format, scores), "")


def _score(scores: dict[str, float], key: str) -> str:
    return f"{scores[key]:.2f}" if key in scores else "-"


def _write(
    out: Path,
    clip: Path,
    table: Table,
    rows: list[Row],
    done: dict[str, FinishedRun],
    unused: dict[str, list[str]],
) -> None:
    facts = {"bigs": bigs.__version__, "clip": str(clip), "machine": machine_facts()}
    numbers = [
        {
            "row": row.name,
            "off": row.off,
            "nothing_of": unused[row.name],
            "paper": None if row.paper is None else dict(zip(_SCORES, row.paper, strict=True)),
            **asdict(done[row.name]),
        }
        for row in rows
        if row.name in done
    ]
    write_json(out / NUMBERS, {**facts, "rows": numbers})
    with atomic_write(out / PAGE) as file:
        file.write(page(f"bigs ablate {clip.name}", f"bigs {bigs.__version__}.", [table]).encode())

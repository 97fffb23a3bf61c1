"""Commands that score runs: eval and submission."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from bigs.checks import InputError
from bigs.cli.terminal import importing, print_table, print_tables, say, telling, use_threads


def evaluate(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN ...")],
    gt: Path | None = None,
    clip: Path | None = None,
    novel: Path | None = None,
    hand_model: Path | None = None,
    perceptual_weights: tuple[Path, ...] = (),
    out: Path | None = None,
    all: bool = False,
    threads: int = 0,
) -> None:
    """Score finished runs as the field's evaluators do; several make a table beside the paper's.

    Each run gets its scores in metrics.json, scores.csv and report.html, and a row per frame in frames.csv.

    Args:
        runs: run folders.
        gt: ground truth of one run: gt.npz or the folder that holds it, a sequence of ARCTIC's raw release
            (ROOT/s05/box_grab_01/1), or a clip of HO-3D; the gt.npz of the run's own clip by default.
        clip: images and masks of one run; the run's own clip by default.
        novel: held-out views of one run (image/, mask/, cameras.npz); its clip's folder novel by default.
        hand_model: MANO-format files for a data set's poses; the run's own by default.
        perceptual_weights: VGG-16 as torchvision publishes it, and LPIPS's channel weights, for LPIPS.
        out: folder for comparison.md and comparison.csv, beside the paper's Tables 1, 2 and 4.
        all: show every score of a run, not only the first five; scores.csv has them too.
        threads: CPU threads; 0 uses all cores.
    """
    with importing():
        use_threads(threads)
        from bigs.commands.evaluate.paper_tables import beside_paper
        from bigs.commands.evaluate.runs import EvaluationPlan, compare_runs, evaluate_run, run_names

    if not runs:
        raise InputError("bigs eval: expected a run folder, found none")
    for option, value in (("--gt", gt), ("--clip", clip), ("--novel", novel)):
        if value is not None and len(runs) > 1:
            raise InputError(f"{option}: expected one run with it, found {len(runs)}")
    plan = EvaluationPlan(gt, clip, novel, hand_model, perceptual_weights)
    names = run_names(runs)
    with telling() as tell:
        found = {name: evaluate_run(run, plan, tell) for name, run in zip(names, runs, strict=True)}
    for name, evaluation in found.items():
        for line in evaluation.remarks:
            say(f"{name}: {line}")
    if len(runs) == 1:
        evaluation = found[names[0]]
        print_table(evaluation.table() if all else evaluation.headlines())
        for line in evaluation.meanings():
            say(line)
        say(
            f"all scores: {runs[0] / 'scores.csv'}"
            + ("" if all else ", or --all; they stand in report.html, too")
        )
    elif out is None:
        scores = {name: evaluation.scores["result"] for name, evaluation in found.items()}
        for table in beside_paper(scores, {name: evaluation.input for name, evaluation in found.items()}):
            say(f"\n{table.title}")
            print_table(table.rows)
            say(table.note)
    if out is not None:
        print_tables(compare_runs(found, out), out)


def submission(
    archive: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="ZIP")],
    runs: tuple[Path, ...] = (),
    sequences: tuple[str, ...] | None = None,
    hold_class: bool = False,
) -> None:
    """Pack finished runs into the ARCTIC challenge's arctic_preds.zip, or check such a zip.

    Every file name, key, shape and type that the server reads is checked, since it reports no mistake.

    Args:
        archive: the zip to write, or to check if no runs are given.
        runs: run folders, one for each sequence.
        sequences: expected sequences; the nine clips of subject 3 and camera 1 by default.
        hold_class: write dictionaries of HOLD's class common.xdict.xdict, for an evaluator that calls its
            methods; opening them then needs that class.
    """
    from bigs.commands.export.submission import submit

    if hold_class and not runs:
        raise InputError("--hold-class: expected --runs with it, found none")
    print_table(submit(archive, runs, sequences, hold_class=hold_class))
    say(f"{archive} is complete")

"""Reconstruction: a clip goes in, a run folder with hands and object comes out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import bigs
from bigs.atomic import remove_parts
from bigs.checks import InputError
from bigs.commands.clips.open import open_estimates
from bigs.commands.clips.truth import load_truth
from bigs.commands.evaluate.picture_scores import frame_scores, means, partly
from bigs.commands.export.formats import write_outputs
from bigs.commands.folder.contents import (
    CHECKPOINTS,
    CONFIG,
    LOG,
    METRICS,
    write_json,
)
from bigs.commands.folder.lock import only_writer
from bigs.commands.folder.log import RunLog
from bigs.commands.folder.options import check_same_options
from bigs.commands.prior.weights import load_prior
from bigs.commands.render.run_pictures import Told, draw_pictures, write_run_report
from bigs.hand import load_hand_models
from bigs.losses.perceptual_file import load_perceptual_weights
from bigs.metrics.headlines import headline_meanings, headline_table
from bigs.metrics.picture import ALL_METRICS
from bigs.metrics.report import check_comparable, comparison_table, evaluate, per_frame, remarks
from bigs.models.playback import record
from bigs.threads import beside
from bigs.train.check_plan import check_plan
from bigs.train.fit import Observer, fit
from bigs.train.fit_report import FitReport
from bigs.train.loop.checkpoint import FILE_NAME
from bigs.train.loop.stopwatch import Stopwatch
from bigs.train.plan.config import RunConfig
from bigs.train.plan.config_file import save_config
from bigs.train.resolve import resolve
from bigs.train.start.initial import initial_trajectory
from bigs.types import HandObjectTrajectory


@dataclass(frozen=True)
class Outcome:
    """What to print after a run."""

    run: Path
    table: list[tuple[str, ...]]  # the first scores; the first row is the heading
    report: FitReport
    seconds: float  # sum of the report's times, interrupted runs included
    meanings: tuple[str, ...] = ()  # explanations of the scores in the table


def reconstruct(
    clip_path: Path,
    out: Path,
    config: RunConfig,
    *,
    hand_model: Path | None = None,
    ground_truth: Path | None = None,
    resume: bool = False,
    listen: Callable[[dict[str, Any]], None] = lambda event: None,
    watch: Stopwatch | None = None,
    observe: Observer | None = None,
) -> Outcome:
    """Reconstruct a clip into a run folder.

    Everything is checked before the folder is touched, so that bad input leaves nothing half written.

    Args:
        clip_path: a clip with estimates, of any layout.
        out: the run folder; made if missing. One that holds a run is refused unless `resume` is set.
        config: see `bigs.train.plan.presets`. The run folder's config.yaml is what `resolve` makes of it.
        hand_model: folder or file of MANO-format models; None takes the built-in hand.
        ground_truth: scores the result and the initial estimates (see `load_truth`); never seen by the
            optimisation.
        resume: continue an interrupted run.
        listen: told of stages, steps and notes, for progress displays.
        watch: goes on from what the caller did before; a new one if not given.
        observe: sees the scene along the way; see `fit`.

    Raises:
        InputError: bad input, in one sentence.
    """
    watch = watch or Stopwatch("loading")
    watch.begin("loading")
    check_plan(config)
    hand_models = load_hand_models(hand_model)
    clip = open_estimates(clip_path, hand_models)
    resolved = resolve(config, has_object=clip.object is not None)
    config = resolved.config
    files = [Path(path) for path in config.perceptual_weights]
    network = load_perceptual_weights(files) if files else None
    denoiser = load_prior(config.prior)
    truth = None if ground_truth is None else load_truth(ground_truth, clip.frame_names, hand_models)
    if (out / CONFIG).exists() and not resume:
        raise InputError(f"{out}: expected a new run folder, found a run (pass --resume to continue it)")
    origin = run_origin(clip_path, hand_model)
    begun = (out / CHECKPOINTS / FILE_NAME).exists()
    if begun and (out / CONFIG).exists():
        check_same_options(out, config, origin)
    baseline = initial_trajectory(clip, hand_models)
    if truth is not None:
        check_comparable(baseline, truth)

    out.mkdir(parents=True, exist_ok=True)
    with only_writer(out), beside(2) as pool:
        # The start values leave a core to spare for it.
        initial = None if truth is None else pool.submit(evaluate, baseline, truth)
        remove_parts(out)
        # A checkpoint of another configuration is refused; without one, compare the options.
        if not begun:
            save_config(out / CONFIG, config, origin)
        with RunLog(out / LOG, resume) as log:

            def log_and_listen(event: dict[str, Any]) -> None:
                log.add(event)
                if event["event"] != "resume":
                    listen(event)

            for note in clip.notes:
                log_and_listen({"event": "note", "stage": "clip", "text": f"note: {note}"})
            if resolved.perceptual and not begun:
                log_and_listen({"event": "note", "stage": "start values", "text": resolved.perceptual})
            listen({"event": "note", "stage": "start values", "text": "finding start values"})
            scene, report = fit(
                clip,
                hand_models,
                config,
                perceptual=network,
                denoiser=denoiser,
                checkpoints=out / CHECKPOINTS,
                resume=resume,
                listen=log_and_listen,
                watch=watch,
                observe=observe,
            )
            report.skipped[:0] = resolved.notes
            watch.begin("results")
            if clip.notes:
                report.facts["clip"] = "; ".join(clip.notes)
            playback = record(scene, clip.name, clip.frame_names, clip.normalize_shift, clip.fps)
            listen({"event": "note", "stage": "outputs", "text": "writing results"})
            write_outputs(out, playback)
            watch.begin("scores")
            listen({"event": "note", "stage": "outputs", "text": "scoring, drawing pictures"})
            # None needs another, nor much of the interpreter.
            drawing = pool.submit(draw_pictures, out, clip, playback)
            found = playback.trajectory()
            judging = None if truth is None else pool.submit(_judge, found, truth)
            frames = frame_scores(clip, playback)
            of_frames, against_truth = ({}, {}) if judging is None else judging.result()
            scores = {} if initial is None else {"initial": initial.result()}
            scores["result"] = against_truth | means(frames)
            for line in report.skipped:
                log_and_listen({"event": "skipped", "text": line})
            write_json(out / METRICS, scores)
            watch.begin("pictures")
        drawn = drawing.result()
        told = partly(frames)
        if truth is not None:
            told |= remarks(found, truth)
        table = comparison_table(scores, ALL_METRICS, told=told)
        frames |= of_frames

        def times() -> dict[str, float]:
            report.seconds = watch.read()
            return report.seconds

        write_run_report(out, clip, playback, drawn, Told(table, frames, log.events, report, times))
        return Outcome(
            out,
            headline_table(scores, told),
            report,
            sum(report.seconds.values()),
            tuple(headline_meanings(scores, told)),
        )


def _judge(
    found: HandObjectTrajectory, truth: HandObjectTrajectory
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Scores of every frame, and those of the clip."""
    of_frames = per_frame(found, truth)
    return of_frames, evaluate(found, truth, of_frames)


def run_origin(clip_path: Path, hand_model: Path | None) -> dict[str, str | None]:
    """What identifies a run besides its configuration, as it stands in `config.yaml`."""
    return {
        "bigs": bigs.__version__,
        "torch": str(torch.__version__),
        "clip": str(Path(clip_path).resolve()),
        "hand_model": None if hand_model is None else str(Path(hand_model).resolve()),
    }

"""Series of runs, one folder each: finished ones are kept, and one that fails does not lose the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bigs.checks import InputError
from bigs.commands.clips.open import open_estimates
from bigs.commands.clips.truth import load_truth
from bigs.commands.folder.contents import CHECKPOINTS, CONFIG, LOG, METRICS, read_scores, write_json
from bigs.commands.folder.log import read_log
from bigs.commands.run.curve import Curve
from bigs.commands.run.reconstruct import reconstruct, run_origin
from bigs.files import read_json, read_yaml
from bigs.hand import load_hand_models
from bigs.train.loop.profile import Profile, profiled
from bigs.train.plan.config import RunConfig
from bigs.train.plan.config_file import load_config
from bigs.train.resolve import resolve

# Written last, so a folder that has it holds a finished run of a series.
TIMES = "times.json"
CURVE = "curve.json"

# Receives a short text on what is being done.
Listener = Callable[[str], None]


@dataclass(frozen=True)
class PlannedRun:
    """One run of a series."""

    folder: Path
    clip: Path
    config: RunConfig
    hand_model: Path | None
    ground_truth: Path | None
    # CPU seconds between the points of its curve (see `Curve`); None keeps no curve.
    curve: float | None = None


@dataclass(frozen=True)
class FinishedRun:
    """The outcome of a run of a series."""

    scores: dict[str, dict[str, float]] = field(default_factory=dict)  # "initial" and "result"
    times: dict[str, Any] = field(default_factory=dict)  # seconds; see `run_or_reuse`
    skipped: list[str] = field(default_factory=list)
    # Scores along the run, with the stage, its steps, and wall and CPU seconds until then.
    curve: list[dict[str, Any]] = field(default_factory=list)
    failure: str = ""  # why there is no result
    reused: bool = False  # it was finished before


def check_folders(runs: list[PlannedRun]) -> None:
    """Refuse a series whose folders hold other runs, before any is started.

    Raises:
        InputError: names the folder and what differs.
    """
    for run in runs:
        path = run.folder / CONFIG
        if not path.exists():
            continue
        if load_config(path) != resolve(run.config).config:
            raise InputError(
                f"{path}: expected the configuration of this run, found another (remove the folder)"
            )
        stored = read_yaml(path)
        for key, value in run_origin(run.clip, run.hand_model).items():
            if stored.get(key) != value:
                raise InputError(
                    f"{path}: {key}: expected {value}, found {stored.get(key)} (remove the folder)"
                )


def run_or_reuse(run: PlannedRun, listen: Listener = lambda text: None) -> FinishedRun:
    """Run unless the folder holds the finished run; an interrupted one continues.

    Returns:
        The outcome, or why there is none. `times` has "wall" and "cpu" (seconds in all), "resumed" (they are
        of the last part only), and for each of "stages" its wall, cpu, steps, in_steps, phases and rest.
    """
    reused = (run.folder / TIMES).exists() and (run.folder / METRICS).exists()
    try:
        if not reused:
            _run(run, listen)
        scores = read_scores(run.folder)
        skipped = [row["text"] for row in read_log(run.folder / LOG) if row["event"] == "skipped"]
        curve = _read(run.folder / CURVE)["points"] if (run.folder / CURVE).exists() else []
        return FinishedRun(scores, _read(run.folder / TIMES), skipped, curve, reused=reused)
    # A failed run gets a row with the reason; the others go on.
    except Exception as error:
        return FinishedRun(failure=f"{type(error).__name__}: {error}")


def _run(run: PlannedRun, listen: Listener) -> None:
    resumed = (run.folder / CHECKPOINTS).exists()
    with profiled() as profile:
        with profile.paused():
            curve = _curve(run, profile)

        def follow(event: dict[str, Any]) -> None:
            profile.listen(event)
            if event["event"] in ("stage", "step", "note"):
                place = f" {event['step']}/{event['steps']}" if event["event"] == "step" else ""
                listen(f"{run.folder.name}: {event['stage']}{place}")

        reconstruct(
            run.clip,
            run.folder,
            run.config,
            hand_model=run.hand_model,
            ground_truth=run.ground_truth,
            resume=(run.folder / CONFIG).exists(),
            listen=follow,
            observe=curve,
        )
    stages = {
        name: {
            "wall": stage.wall,
            "cpu": stage.cpu,
            "steps": stage.steps,
            "in_steps": stage.in_steps,
            "phases": stage.phases,
            "rest": stage.rest,
        }
        for name, stage in profile.stages.items()
    }
    write_json(
        run.folder / TIMES,
        {
            "wall": sum(stage.wall for stage in profile.stages.values()),
            "cpu": sum(stage.cpu for stage in profile.stages.values()),
            "resumed": resumed,
            "stages": stages,
        },
    )


def _curve(run: PlannedRun, profile: Profile) -> Curve | None:
    if run.curve is None:
        return None
    hand_models = load_hand_models(run.hand_model)
    clip = open_estimates(run.clip, hand_models)
    truth = None if run.ground_truth is None else load_truth(run.ground_truth, clip.frame_names, hand_models)
    return Curve(clip, truth, profile, run.curve, run.folder / CURVE)


def _read(path: Path) -> dict[str, Any]:
    return read_json(path, "what a finished run holds")

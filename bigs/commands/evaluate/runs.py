"""Scores of finished runs: against ground truth, on the clip's own frames, and in held-out views."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bigs.atomic import atomic_write
from bigs.bench.page import Table, page
from bigs.checks import InputError
from bigs.commands.clips.open import open_clip
from bigs.commands.clips.truth import find_ground_truth, is_own_truth, load_truth
from bigs.commands.evaluate.paper_tables import RunInput, beside_paper, mean_scores
from bigs.commands.evaluate.picture_scores import frame_scores, means, novel_scores, partly
from bigs.commands.folder.clip import hand_models_of_run, origin_of
from bigs.commands.folder.contents import METRICS, REPORT, load_run, read_scores, write_json
from bigs.data.base import Clip
from bigs.data.formats.ho3d import find_ho3d
from bigs.data.novel import CAMERAS
from bigs.hand import HandModel, load_hand_models
from bigs.losses.perceptual import VggWeights, perceptual_distance
from bigs.losses.perceptual_file import load_perceptual_weights
from bigs.metrics.headlines import headline_meanings, headline_table
from bigs.metrics.picture import ALL_METRICS, Distance
from bigs.metrics.report import comparison_table, evaluate, match_frames, per_frame
from bigs.metrics.report import remarks as remarks_on
from bigs.models.playback import Playback
from bigs.train.start.initial import initial_trajectory
from bigs.types import Side
from bigs.viewer.report import replace_scores

FRAMES = "frames.csv"
# In a folder of data, or above it: that it was generated, whatever its layout.
MADE_BY_CODE = "made_by_code.txt"
SCORES = "scores.csv"
COMPARISON = "comparison.md"
COMPARISON_NUMBERS = "comparison.csv"

# What the official code does differently from what it says; it stands below every comparison.
OFFICIAL_NOTES = (
    "The public ARCTIC evaluator computes CD_r and CD_l from plain distances and prints cm, the HO-3D "
    "evaluator from squared ones (cm²), and the paper labels both cm²: `cd_r_sq` and `cd_l_sq` are squared, "
    "`cd_r` and `cd_l` plain. Both sums run over the two directions and are not halved. For CD_o the ARCTIC "
    "evaluator scores its first alignment with plain and 600 others with squared distances and prints "
    "the smallest number: `cd_icp_sq` and `cd_icp` are two forms of one alignment, `cd_icp_arctic` is the "
    "smaller. That evaluator draws its samples without a seed; here nothing changes from run to run."
)


@dataclass(frozen=True)
class EvaluationPlan:
    """What to score a run with; missing parts come from the run's own clip, if it exists."""

    ground_truth: Path | None = None  # see `load_truth`
    clip: Path | None = None  # for its images and masks
    novel: Path | None = None  # see `load_novel_views`
    hand_model: Path | None = None  # for a data set's poses
    perceptual_weights: tuple[Path, ...] = ()  # VGG-16 and LPIPS's channel weights


@dataclass(frozen=True)
class Evaluation:
    """The scores of one run."""

    name: str  # of the clip
    scores: dict[str, dict[str, float]]  # "result", and "initial" where the run had it, by key
    frames: dict[str, np.ndarray]  # by key, [T]
    remarks: tuple[str, ...]  # what could not be scored, and what to keep in mind
    told: dict[str, str]  # why a score is missing, or over how many frames it is, by key
    input: RunInput = field(default_factory=RunInput)

    def table(self) -> list[tuple[str, ...]]:
        """All scores as rows of text."""
        return comparison_table(self.scores, ALL_METRICS, details=True, told=self.told)

    def headlines(self) -> list[tuple[str, ...]]:
        """The headline scores."""
        return headline_table(self.scores, self.told)

    def meanings(self) -> list[str]:
        """A line of explanation for each headline."""
        return headline_meanings(self.scores, self.told)


def evaluate_run(
    run: Path, plan: EvaluationPlan, listen: Callable[[str], None] = lambda text: None
) -> Evaluation:
    """Score a run into its `metrics.json`, which keeps its initial estimates' scores, and `frames.csv`.

    Raises:
        InputError: the run, the truth or the clip is invalid, they list different frames, or
            there is nothing to score against.
    """
    playback = load_run(run)
    origin = origin_of(run)
    clip_path = plan.clip or origin.clip
    distance = _perceptual(plan.perceptual_weights)
    truth_path = plan.ground_truth or (find_ground_truth(clip_path) if clip_path else None)
    remarks: list[str] = []
    hand_models = hand_models_of_run(run)
    hand_file = plan.hand_model or origin.hand_model
    if plan.hand_model is not None or (truth_path is not None and not is_own_truth(truth_path)):
        # A data set's poses are its truth on the hand that they were fitted with, and on no other.
        hand_models = load_hand_models(hand_file)
        if hand_file is None:
            remarks.append("the data set's poses are on the built-in hand; give theirs with --hand-model")
    clip = _open_frames(clip_path, hand_models, playback, given=plan.clip is not None)
    if clip is None and truth_path is None and plan.novel is None:
        raise InputError(
            f"{run}: expected something to score against (--gt, --clip or --novel), found neither "
            f"that nor the run's own clip {clip_path}"
        )
    initial: dict[str, float] = {}
    result: dict[str, float] = {}
    frames: dict[str, np.ndarray] = {}
    told: dict[str, str] = {}
    if truth_path is None:
        remarks.append("poses and shapes are not scored: no ground truth (--gt)")
    else:
        listen(f"{run.name}: poses and shapes")
        truth = load_truth(truth_path, playback.frame_names, hand_models)
        found = playback.trajectory()
        of_frames = per_frame(found, truth)
        result |= evaluate(found, truth, of_frames)
        told |= remarks_on(found, truth)
        if clip is not None and clip.hands and not clip.annotated:
            listen(f"{run.name}: initial estimates")
            initial = evaluate(initial_trajectory(clip, hand_models_of_run(run)), truth)
        order = match_frames(truth.frame_names, playback.frame_names)
        frames |= {key: v[order] for key, v in of_frames.items()}
    if clip is None:
        remarks.append("pictures are not scored: the run's clip was not found (--clip)")
    else:
        listen(f"{run.name}: pictures")
        pictures = frame_scores(clip, playback, distance)
        frames |= pictures
        result |= means(pictures)
        told |= partly(pictures)
    novel = plan.novel or _own_novel(clip_path)
    if novel is not None:
        listen(f"{run.name}: held-out views")
        result |= novel_scores(playback, novel, distance, result.get("clip_scale"))
    if distance is None:
        remarks.append("LPIPS is not scored: no weights (--perceptual-weights)")
    remarks += _told_once(told)
    scores = read_scores(run)
    # An earlier score that cannot be had any more does not stand beside the reason.
    earlier = {key: v for key, v in scores.get("result", {}).items() if key not in told}
    begun = initial or scores.get("initial")
    scores = ({"initial": begun} if begun else {}) | {"result": earlier | result}
    write_json(run / METRICS, scores)
    _write_frames(run / FRAMES, playback.frame_names, frames)
    _write_scores(run / SCORES, scores)
    given = _input_of(playback, truth_path, clip_path)
    evaluation = Evaluation(playback.name, scores, frames, tuple(remarks), told, given)
    if (run / REPORT).is_file() and not replace_scores(run / REPORT, evaluation.table()):
        remarks.append(f"{REPORT} is of an earlier version and keeps its scores")
    return replace(evaluation, remarks=tuple(remarks))


def _input_of(playback: Playback, truth: Path | None, clip: Path | None) -> RunInput:
    """What a run was made from: a data set's clip is known by its truth, or by its name."""
    places = [place for path in (truth, clip) if path is not None for place in (path, *path.parents)]
    told = f"{len(playback)} frames"
    if any((place / MADE_BY_CODE).is_file() for place in places):
        return RunInput("", f"{told}, generated")
    data_set = ""
    if truth is not None and not is_own_truth(truth):
        data_set = "HO-3D" if truth.is_dir() and find_ho3d(truth) is not None else "ARCTIC"
    elif re.fullmatch(r"arctic_s\d+_.+_\d", playback.name):
        data_set = "ARCTIC"
    elif re.fullmatch(r"hold_.+_ho3d", playback.name):
        data_set = "HO-3D"
    return RunInput(data_set, f"{told} of {data_set}" if data_set else told)


def run_names(runs: Sequence[Path]) -> list[str]:
    """Names of runs in a table: those of their folders, or the paths if these repeat.

    Raises:
        InputError: a folder comes twice.
    """
    folders = [run.resolve() for run in runs]
    for folder in folders:
        if folders.count(folder) > 1:
            raise InputError(f"{folder}: expected each run once, found it again")
    names = [folder.name for folder in folders]
    return names if len(set(names)) == len(names) else [str(run) for run in runs]


def compare_runs(runs: Mapping[str, Evaluation], out: Path) -> list[Table]:
    """Write the scores of several runs beside the paper's: `comparison.md` and, with every score, a CSV."""
    out.mkdir(parents=True, exist_ok=True)
    results = {name: evaluation.scores["result"] for name, evaluation in runs.items()}
    tables = beside_paper(results, {name: evaluation.input for name, evaluation in runs.items()})
    columns = results | ({"mean": mean_scores(results)} if len(results) > 1 else {})
    everything = Table("All scores", OFFICIAL_NOTES, comparison_table(columns, ALL_METRICS, details=True))
    keys = [key for key in ALL_METRICS if any(key in scores for scores in results.values())]
    _write_csv(
        out / COMPARISON_NUMBERS,
        ["run", "clip", *keys],
        [[name, runs[name].name, *(scores.get(key, "") for key in keys)] for name, scores in results.items()],
    )
    text = page(
        "Runs compared", "Scores of finished runs, and the paper's beside them.", [*tables, everything]
    )
    with atomic_write(out / COMPARISON) as file:
        file.write(text.encode())
    return tables


def _told_once(told: Mapping[str, str]) -> list[str]:
    """Remarks on scores, each once, with the scores that it concerns."""
    lines = []
    for text in dict.fromkeys(told.values()):
        names = [ALL_METRICS[key].paper for key in told if told[key] == text]
        shown = ", ".join(names[:3]) + (f" and {len(names) - 3} others" if len(names) > 3 else "")
        lines.append(f"{text}: {shown}")
    return lines


def _perceptual(files: Sequence[Path]) -> Distance | None:
    if not files:
        return None
    network: VggWeights = load_perceptual_weights(files)
    if network.channel_weights is None:
        raise InputError(
            f"--perceptual-weights: expected LPIPS's channel weights (lin0 to lin4) beside VGG-16, found "
            f"only {' and '.join(map(str, files))}"
        )
    return lambda pred, gt: perceptual_distance(pred, gt, network)


def _open_frames(
    path: Path | None, hand_models: Mapping[Side, HandModel], playback: Playback, *, given: bool
) -> Clip | None:
    """The clip with the run's frames; None when the run's own is gone or has no masks."""
    if path is None or (not given and not path.exists()):
        return None
    clip = open_clip(path, hand_models)
    if clip.frame_names != playback.frame_names:
        raise InputError(
            f"{path}: expected the run's {len(playback)} frames from {playback.frame_names[0]} on, found "
            f"{len(clip)} from {clip.frame_names[0]} on"
        )
    if not clip.mask_paths:
        if given:
            raise InputError(f"{path}: expected a clip with masks, found none")
        return None
    return clip


def _own_novel(clip_path: Path | None) -> Path | None:
    """A clip's held-out views, beside its build folder."""
    if clip_path is None:
        return None
    folder = (clip_path.parent if clip_path.name == "build" else clip_path) / "novel"
    return folder if (folder / CAMERAS).is_file() else None


def _write_scores(path: Path, scores: Mapping[str, Mapping[str, float]]) -> None:
    """Every score with its name, unit and direction, a row each."""
    keys = [key for key in ALL_METRICS if any(key in row for row in scores.values())]
    rows = [[key, *ALL_METRICS[key][:3], *(row.get(key, "") for row in scores.values())] for key in keys]
    _write_csv(path, ["key", "score", "unit", "better", *scores], rows)


def _write_frames(path: Path, names: Sequence[str], columns: Mapping[str, np.ndarray]) -> None:
    rows = [[t, name, *(f"{values[t]:.6g}" for values in columns.values())] for t, name in enumerate(names)]
    _write_csv(path, ["frame", "name", *columns], rows)


def _write_csv(path: Path, heading: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(heading)
    writer.writerows(rows)
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())

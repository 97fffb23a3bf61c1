"""Preprocessing on clips with ground truth and on harder variants: errors and flags."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import bigs
from bigs.atomic import atomic_write
from bigs.bench.machine import machine_facts
from bigs.bench.page import Rows, Table, page
from bigs.checks import InputError, check_choice
from bigs.commands.bench.reconstruct import clip_names
from bigs.commands.bench.variants import VARIANTS, Given, Variant, truth_of, write_variant
from bigs.commands.clips.open import open_estimates
from bigs.commands.clips.truth import find_ground_truth
from bigs.commands.folder.contents import write_json
from bigs.commands.preprocess.all_steps import preprocess
from bigs.commands.preprocess.request import PreprocessRequest
from bigs.data.base import Clip
from bigs.data.formats.hold import load_hold
from bigs.data.ground_truth import load_annotation, load_ground_truth
from bigs.geometry.rotations import robust_mean_rotation
from bigs.hand import HandModel, load_hand_models
from bigs.metrics.report import evaluate
from bigs.preprocess.artefacts import (
    ALIGNED_FILE,
    SFM_FILE,
    Alignment,
    read_alignment,
    read_object_sfm,
)
from bigs.preprocess.frames.camera import CameraRequest
from bigs.preprocess.frames.extract import FrameConfig
from bigs.train.start.initial import initial_trajectory
from bigs.types import HandObjectTrajectory, Side

PAGE = "preprocess.md"
NUMBERS = "preprocess.json"

# A frame whose rotation is off by more than this is wrong and should be flagged, degrees.
WRONG = 6.0
# A flag on a frame that is off by less than this is a false alarm, degrees.
RIGHT = 3.0

# Scores of initial estimates and their headings.
_SCORES = {
    "mpjpe_ra_r": "MPJPE_r mm",
    "mpjpe_ra_l": "MPJPE_l mm",
    "wrist_r": "wrist_r mm",
    "wrist_l": "wrist_l mm",
    "depth_r": "depth_r mm",
    "depth_l": "depth_l mm",
    "cd_r_sq": "CD_r cm²",
    "cd_l_sq": "CD_l cm²",
    "cd_icp_sq": "CD_o cm²",
    "f5_icp": "F5 %",
    "f10_icp": "F10 %",
    "f10_cam": "F10 camera %",
    "clip_scale": "clip scale",
}


@dataclass(frozen=True)
class PreprocessPlan:
    """The options of `bigs bench preprocess`."""

    clips: tuple[Path, ...]
    variants: tuple[str, ...] = tuple(VARIANTS)
    hand_model: Path | None = None
    seed: int = 0  # seed of the noise


@dataclass(frozen=True)
class PreprocessBench:
    """The tables, and the clips that made no build folder."""

    tables: list[Table]
    failed: list[str]


class ObjectErrors(NamedTuple):
    """The object's poses against the truth, after one similarity of its frame."""

    degrees: np.ndarray  # [T]
    millimetres: np.ndarray  # [T] error of its position, at the true size
    size: float  # estimated size over the true one

    def wrong(self) -> np.ndarray:
        """Frames [T] (bool) whose turn is off by more than `WRONG`."""
        return self.degrees > WRONG


def bench_preprocess(
    plan: PreprocessPlan, out: Path, listen: Callable[[str], None] = lambda text: None
) -> PreprocessBench:
    """Preprocess every variant of every clip from pictures, masks and simulated keypoints, and score it.

    Args:
        plan: what to run.
        out: gets CLIP/VARIANT folders, `preprocess.md` and `preprocess.json`.
        listen: told what is being done.

    Raises:
        InputError: a clip has no ground truth, or there is no such variant.
    """
    names = clip_names(plan.clips)
    for variant in plan.variants:
        check_choice("--variants", variant, VARIANTS)
    hand_models = load_hand_models(plan.hand_model)
    subjects = {name: _subject(path, hand_models) for name, path in zip(names, plan.clips, strict=True)}
    out.mkdir(parents=True, exist_ok=True)
    report: dict[str, Any] = {
        "machine": machine_facts(),
        "bigs": bigs.__version__,
        "seed": plan.seed,
        "shipped": {
            name: _initial_scores(subject.clip, hand_models, subject.truth)
            for name, subject in subjects.items()
        },
        "runs": [],
    }
    tables: list[Table] = []
    for name, subject in subjects.items():
        for variant in plan.variants:
            at = f"{name}: {variant}"
            listen(at)
            row = _measure(
                subject,
                VARIANTS[variant],
                out / name / variant,
                plan,
                hand_models,
                lambda text, at=at: listen(f"{at}: {text}"),  # type: ignore[misc]
            )
            report["runs"].append({"clip": name, "variant": variant} | row)
            tables = _write(out, report)
    return PreprocessBench(tables, [f"{r['clip']}: {r['variant']}" for r in report["runs"] if "failure" in r])


class _Subject(NamedTuple):
    clip: Clip
    truth: HandObjectTrajectory
    rotations: np.ndarray  # [T, 3, 3] of the true object
    transl: np.ndarray  # [T, 3]


def _subject(path: Path, hand_models: Mapping[Side, HandModel]) -> _Subject:
    file = find_ground_truth(path)
    if file is None:
        raise InputError(f"{path}: expected a clip with gt.npz beside its build folder, found none")
    poses = load_annotation(file).object
    if poses is None:
        raise InputError(f"{file}: expected an object, found none")
    return _Subject(open_estimates(path, hand_models), load_ground_truth(file), poses.rotations, poses.transl)


def _measure(
    subject: _Subject,
    variant: Variant,
    folder: Path,
    plan: PreprocessPlan,
    hand_models: Mapping[Side, HandModel],
    listen: Callable[[str], None],
) -> dict[str, Any]:
    """One row of the report."""
    given = write_variant(folder, subject.clip, subject.truth, variant, plan.seed)
    request = _request(folder, given, subject.clip, variant, plan)
    row: dict[str, Any] = {"frames": len(given.frames)}
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        steps = preprocess(request, listen=listen)
    except InputError as error:
        return row | {
            "failure": str(error),
            "seconds": time.perf_counter() - wall,
            "cpu_seconds": time.process_time() - cpu,
        }
    row |= {
        "seconds": time.perf_counter() - wall,
        "cpu_seconds": time.process_time() - cpu,
        "steps": {step.name: step.seconds for step in steps},
        "notes": [note for step in steps for note in step.notes],
    }
    row |= _object_scores(request, subject.rotations[given.frames], subject.transl[given.frames])
    truth = truth_of(subject.truth, given)
    return row | {"initial": _initial_scores(load_hold(request.clip), hand_models, truth)}


def object_errors(alignment: Alignment, rotations: np.ndarray, transl: np.ndarray) -> ObjectErrors:
    """Compare with the true poses [T, 3, 3] and [T, 3], metres."""
    found = alignment.object_rotations
    between = found.transpose(0, 2, 1) @ rotations
    usual = robust_mean_rotation(torch.from_numpy(between)).numpy()
    degrees = np.degrees(Rotation.from_matrix(between @ usual.T).magnitude())
    # The true frame's origin lies at some o of the estimated one: transl = size_ratio (t + R o), robustly.
    shift, ratio, weight = np.zeros(3), 1.0, np.ones(len(transl))
    for _ in range(20):
        columns = np.concatenate([alignment.object_transl[:, :, None], found], axis=2)
        root = np.sqrt(weight)[:, None]
        solution, *_ = np.linalg.lstsq(
            (root[:, :, None] * columns).reshape(-1, 4), (root * transl).ravel(), rcond=None
        )
        ratio, shift = float(solution[0]), solution[1:]
        error = np.linalg.norm(columns @ solution - transl, axis=1)
        weight = 1.0 / np.maximum(error, 1e-3)
    placed = ratio * alignment.object_transl + found @ shift
    return ObjectErrors(degrees, 1000.0 * np.linalg.norm(placed - transl, axis=1), 1.0 / ratio)


def _request(
    folder: Path, given: Given, clip: Clip, variant: Variant, plan: PreprocessPlan
) -> PreprocessRequest:
    K = (clip.K[0, 0], clip.K[1, 1], clip.K[0, 2], clip.K[1, 2])
    return PreprocessRequest(
        clip=folder / "clip",
        source=given.pictures,
        frames=FrameConfig(camera=CameraRequest(K=K) if variant.focal_known else CameraRequest()),
        masks=given.masks,
        keypoints=given.keypoints,
        hand_model=plan.hand_model,
        redo=True,
    )


def _object_scores(request: PreprocessRequest, rotations: np.ndarray, transl: np.ndarray) -> dict[str, Any]:
    frames = len(transl)
    sfm = read_object_sfm(request.processed / SFM_FILE, frames)
    errors = object_errors(read_alignment(request.processed / ALIGNED_FILE, frames), rotations, transl)
    flagged = sfm.confidence == 0
    silent = errors.wrong() & ~flagged
    return {
        "degrees": errors.degrees.round(3).tolist(),
        "millimetres": errors.millimetres.round(2).tolist(),
        "size": errors.size,
        "posed": float(sfm.valid.mean()),
        "flagged": np.flatnonzero(flagged).tolist(),
        "silent": np.flatnonzero(silent).tolist(),
        "points": len(sfm.points),
    }


def _initial_scores(
    clip: Clip, hand_models: Mapping[Side, HandModel], truth: HandObjectTrajectory
) -> dict[str, float]:
    found = initial_trajectory(clip, hand_models)
    return evaluate(found, truth) | _depth_errors(found, truth)


def _write(out: Path, report: dict[str, Any]) -> list[Table]:
    tables = [_object_table(report), _initial_table(report)]
    write_json(out / NUMBERS, report)
    machine = report["machine"]
    introduction = (
        f"bigs {report['bigs']}, {machine['cpu']}, {machine['cores']} cores, load at the start "
        f"{machine['load']:.1f}. Pictures, masks and simulated keypoints of clips with ground truth."
    )
    with atomic_write(out / PAGE) as file:
        file.write(page("bigs bench preprocess", introduction, tables).encode())
    return tables


def _object_table(report: dict[str, Any]) -> Table:
    rows: Rows = [
        (
            "clip", "variant", "frames", "posed %", "median °", "p90 °", "worst unflagged °", "flagged",
            "for nothing", f"> {WRONG:g}°", "of them unflagged", "size %", "place mm", "CPU s", "wall s",
        )
    ]  # fmt: skip
    for row in report["runs"]:
        head = (row["clip"], row["variant"], str(row["frames"]))
        times = (f"{row['cpu_seconds']:.0f}", f"{row['seconds']:.0f}")
        if "failure" in row:
            rows.append((*head, "none: " + row["failure"], *[""] * 9, *times))
            continue
        degrees, flagged = np.array(row["degrees"]), np.zeros(row["frames"], dtype=bool)
        flagged[row["flagged"]] = True
        worst = degrees[~flagged].max() if not flagged.all() else np.nan
        rows.append(
            (
                *head,
                f"{100 * row['posed']:.0f}",
                f"{np.median(degrees):.2f}",
                f"{np.percentile(degrees, 90):.1f}",
                f"{worst:.1f}",
                str(flagged.sum()),
                str((flagged & (degrees < RIGHT)).sum()),
                str((degrees > WRONG).sum()),
                str(len(row["silent"])),
                f"{100 * (row['size'] - 1):+.1f}",
                f"{np.median(row['millimetres']):.1f}",
                *times,
            )
        )
    shown = "; ".join(f"{name}: {VARIANTS[name].what}" for name in {r["variant"]: 0 for r in report["runs"]})
    note = (
        "The turn's error over all frames after one similarity to the truth (the rotation with the least sum "
        f"of angles). A frame that is off by more than {WRONG:g} degrees is wrong and has to be flagged; one "
        f"that is off by less than {RIGHT:g} and flagged was flagged for nothing. Variants: {shown}."
    )
    return Table("The object's motion", note, rows)


def _initial_table(report: dict[str, Any]) -> Table:
    rows: Rows = [("clip", "variant", *_SCORES.values())]
    for name, shipped in report["shipped"].items():
        found = {"shipped": shipped}
        found |= {r["variant"]: r["initial"] for r in report["runs"] if r["clip"] == name and "initial" in r}
        for variant, scores in found.items():
            rows.append((name, variant, *(_number(scores, key) for key in _SCORES)))
    note = (
        "The build folder's estimates as a reconstruction finds them, scored as `bigs eval` does; `shipped` "
        "are those that came with the clip. Depth: root mean square of the wrist's error along z, unscaled."
    )
    return Table("Initial estimates", note, rows)


def _number(scores: dict[str, float], key: str) -> str:
    if key not in scores:
        return "-"
    return f"{scores[key]:.1f}" if abs(scores[key]) >= 10 else f"{scores[key]:.2f}"


def _depth_errors(found: HandObjectTrajectory, truth: HandObjectTrajectory) -> dict[str, float]:
    """Root mean square error of each wrist along z, millimetres."""
    off = {s: joints[:, 0, 2] - truth.joints[s][:, 0, 2] for s, joints in found.joints.items()}
    return {f"depth_{s[0]}": float(1000.0 * np.sqrt((error**2).mean())) for s, error in off.items()}

"""Object motion from tracks on clips with ground truth, from their own poses and from worse ones."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
from scipy.spatial.transform import Rotation

import bigs
from bigs.atomic import atomic_write
from bigs.bench.machine import machine_facts
from bigs.bench.page import Rows, Table, page
from bigs.checks import InputError, check_choice
from bigs.commands.bench.preprocess import object_errors
from bigs.commands.bench.reconstruct import clip_names
from bigs.commands.clips.open import open_estimates
from bigs.commands.clips.truth import find_ground_truth
from bigs.commands.folder.contents import write_json
from bigs.data.base import Clip
from bigs.data.ground_truth import load_annotation
from bigs.hand import load_hand_models
from bigs.motion.given_poses import GivenPoses
from bigs.motion.tracker import track
from bigs.motion.tracker_config import TrackerConfig
from bigs.preprocess.artefacts import Alignment
from bigs.train.plan.start_config import InitialConfig
from bigs.train.start.initial import object_in_camera, smooth_object
from bigs.types import MASK_VALUES

PAGE = "motion.md"
NUMBERS = "motion.json"

# Damage of a clip: share of frames whose pose is turned by `_GROSS`, and pixels by which every other mask is
# too wide and the rest too narrow.
VARIANTS: dict[str, tuple[float, int]] = {
    "plain": (0.0, 0),
    "poses": (0.1, 0),
    "masks": (0.0, 3),
    "both": (0.1, 3),
}
_GROSS = 60.0  # degrees


@dataclass(frozen=True)
class MotionPlan:
    """The options of `bigs bench motion`."""

    clips: tuple[Path, ...]
    variants: tuple[str, ...] = tuple(VARIANTS)
    hand_model: Path | None = None
    seed: int = 0


def bench_motion(
    plan: MotionPlan, out: Path, listen: Callable[[str], None] = lambda text: None
) -> list[Table]:
    """Track the object of every clip in every variant and compare with its true poses.

    Args:
        plan: what to run.
        out: gets `motion.md` and `motion.json`.
        listen: told what is being done.

    Raises:
        InputError: a clip has no ground truth or no object, or there is no such variant.
    """
    names = clip_names(plan.clips)
    for variant in plan.variants:
        check_choice("--variants", variant, VARIANTS)
    models = load_hand_models(plan.hand_model)
    out.mkdir(parents=True, exist_ok=True)
    report: dict[str, Any] = {
        "machine": machine_facts(),
        "bigs": bigs.__version__,
        "seed": plan.seed,
        "runs": [],
    }
    tables: list[Table] = []
    for name, path in zip(names, plan.clips, strict=True):
        file = find_ground_truth(path)
        truth = None if file is None else load_annotation(file).object
        clip = open_estimates(path, models)
        if truth is None or clip.object is None:
            raise InputError(
                f"{path}: expected a clip with an object and gt.npz beside its build folder, found none"
            )
        for variant in plan.variants:
            listen(f"{name}: {variant}")
            row = _measure(clip, truth.rotations, truth.transl, variant, plan.seed)
            report["runs"].append({"clip": name, "variant": variant} | row)
            tables = _write(out, report)
    return tables


def _measure(
    clip: Clip, rotations: np.ndarray, transl: np.ndarray, variant: str, seed: int
) -> dict[str, Any]:
    share, pixels = VARIANTS[variant]
    rng = np.random.default_rng(seed)
    start = object_in_camera(clip, InitialConfig())
    smooth = smooth_object(start, InitialConfig().smooth_object)
    given = start.rotations.double().numpy()
    wrong = np.sort(rng.choice(len(given), round(share * len(given)), replace=False))
    axes = rng.standard_normal((len(wrong), 3))
    axes *= np.radians(_GROSS) / np.linalg.norm(axes, axis=1, keepdims=True)
    given[wrong] = Rotation.from_rotvec(axes.reshape(-1, 3)).as_matrix() @ given[wrong]
    masks = np.stack([clip.mask(t) == MASK_VALUES["object"] for t in range(len(clip))])
    for t in range(len(masks)) if pixels else ():
        change = (scipy.ndimage.binary_erosion, scipy.ndimage.binary_dilation)[t % 2]
        masks[t] = change(masks[t], iterations=pixels)
    images = [clip.image_as_taken(t) for t in range(len(clip))]
    poses = GivenPoses(given, start.centers.double().numpy(), start.trust.double().numpy())
    wall, cpu = time.perf_counter(), time.process_time()
    found = track(images, masks, np.asarray(clip.K, dtype=np.float64), poses, TrackerConfig())
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu

    def degrees(turned: np.ndarray, placed: np.ndarray) -> np.ndarray:
        valid = np.ones(len(turned), dtype=bool)
        return object_errors(Alignment(1.0, turned, placed, valid, {}), rotations, transl).degrees

    told = np.degrees(np.sqrt(np.einsum("tii->t", found.covariance[:, :3, :3])))
    error = degrees(found.rotations, found.transl)
    return {
        "given": degrees(given, poses.transl).round(3).tolist(),
        "smoothed": degrees(smooth.rotations.double().numpy(), smooth.centers.double().numpy())
        .round(3)
        .tolist(),
        "tracked": error.round(3).tolist(),
        "told": told.round(4).tolist(),
        "over_told": float(np.sqrt(np.mean((error / told) ** 2))),
        "wrong": wrong.tolist(),
        "refuted": np.flatnonzero(found.contradicted).tolist(),
        "points": len(found.points),
        "cpu_seconds": cpu,
        "seconds": wall,
    }


def _write(out: Path, report: dict[str, Any]) -> list[Table]:
    rows: Rows = [
        (
            "clip",
            "variant",
            "given °",
            "smoothed °",
            "tracked °",
            "told °",
            "error / told",
            "refuted",
            "points",
            "CPU s",
        )
    ]
    both = lambda values: f"{np.median(values):.2f}, {np.percentile(values, 90):.2f}"  # noqa: E731
    for run in report["runs"]:
        smoothed = "-" if run["wrong"] else both(run["smoothed"])
        right = len(set(run["wrong"]) & set(run["refuted"]))
        refuted = f"{right} of {len(run['wrong'])}, {len(run['refuted']) - right} more"
        rows.append(
            (
                run["clip"], run["variant"], both(run["given"]), smoothed, both(run["tracked"]),
                f"{np.median(run['told']):.2f}", f"{run['over_told']:.1f}", refuted, str(run["points"]),
                f"{run['cpu_seconds']:.0f}",
            )
        )  # fmt: skip
    table = Table(
        "Object motion from tracks",
        "Errors of the turn over all frames after one turn of its frame, median and 90th percentile, "
        "and the deviation that the tracker told.",
        rows,
    )
    write_json(out / NUMBERS, report)
    machine = report["machine"]
    cores = f"{machine['cores']} cores, load at the start {machine['load']:.1f}"
    introduction = f"bigs {report['bigs']}, {machine['cpu']}, {cores}."
    with atomic_write(out / PAGE) as file:
        file.write(page("bigs bench motion", introduction, [table]).encode())
    return [table]

"""A reconstructed clip against the truth: every pose and shape score under one key each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Literal, NamedTuple

import numpy as np

from bigs.checks import InputError, check_faces, check_finite, check_shape
from bigs.metrics.align import similarity_icp
from bigs.metrics.pose import clip_scale, mpjpe, turn_errors, wrist_error
from bigs.metrics.shape import relative_scores
from bigs.types import SIDES, HandObjectTrajectory, Side


class Metric(NamedTuple):
    """How to read a score."""

    paper: str  # its name in the paper's tables, or a plain description where the paper has none
    unit: str
    better: Literal["lower", "higher", "neither"]
    detail: bool = False  # shown in a full report only


# In the order in which they are printed. The paper labels CD_r, CD_l and CD_o cm², so the squared form
# carries the paper's names; the public ARCTIC evaluator prints the root form of CD_r and CD_l, which stands
# beside it. For CD_o it takes the smaller of one alignment in the root form and 600 in the squared form;
# `cd_icp_arctic` is that of our one alignment.
METRICS: dict[str, Metric] = {
    "mpjpe_ra_r": Metric("MPJPE_r", "mm", "lower"),
    "mpjpe_ra_l": Metric("MPJPE_l", "mm", "lower"),
    "mpjpe_ra_h": Metric("MPJPE, mean of hands", "mm", "lower"),
    "wrist_r": Metric("right wrist, one scale for the clip", "mm", "lower"),
    "wrist_l": Metric("left wrist, one scale for the clip", "mm", "lower"),
    "wrist_h": Metric("wrists, mean of hands, one scale", "mm", "lower"),
    "wrist_unscaled_r": Metric("right wrist in the camera", "mm", "lower"),
    "wrist_unscaled_l": Metric("left wrist in the camera", "mm", "lower"),
    "cd_r_sq": Metric("CD_r", "cm²", "lower"),
    "cd_l_sq": Metric("CD_l", "cm²", "lower"),
    "cd_h_sq": Metric("CD_h", "cm²", "lower"),
    "cd_r": Metric("CD_r, plain distances", "cm", "lower"),
    "cd_l": Metric("CD_l, plain distances", "cm", "lower"),
    "cd_h": Metric("CD_h, plain distances", "cm", "lower"),
    "cd_icp_sq": Metric("CD_o", "cm²", "lower"),
    "cd_icp": Metric("CD_o, plain distances", "cm", "lower"),
    "f5_icp": Metric("F5", "%", "higher"),
    "f10_icp": Metric("F10", "%", "higher"),
    "f5_cam": Metric("F5, one scale for the clip", "%", "higher"),
    "f10_cam": Metric("F10, one scale for the clip", "%", "higher"),
    "rotation": Metric("object rotation, one turn for the clip, median", "degrees", "lower"),
    "clip_scale": Metric("the clip's one scale", "", "neither"),
    "cd_icp_arctic": Metric("CD_o as ARCTIC's evaluator prints it", "", "lower", detail=True),
    "cd_ra_sq": Metric("CD, object about its own centre", "cm²", "lower", detail=True),
    "f5_ra": Metric("F5, object about its own centre", "%", "higher", detail=True),
    "f10_ra": Metric("F10, object about its own centre", "%", "higher", detail=True),
    "f5_r": Metric("F5, object about the right wrist", "%", "higher", detail=True),
    "f10_r": Metric("F10, object about the right wrist", "%", "higher", detail=True),
    "f5_l": Metric("F5, object about the left wrist", "%", "higher", detail=True),
    "f10_l": Metric("F10, object about the left wrist", "%", "higher", detail=True),
    "mrrpe_r": Metric("MRRPE, right wrist to object", "mm", "lower", detail=True),
    "mrrpe_l": Metric("MRRPE, left wrist to object", "mm", "lower", detail=True),
}
# Suffixes of scores of a single frame.
_OF_ONE_FRAME = ("_icp", "_icp_sq", "_icp_arctic")


def evaluate(
    pred: HandObjectTrajectory,
    gt: HandObjectTrajectory,
    of_frames: Mapping[str, np.ndarray] | None = None,
) -> dict[str, float]:
    """All scores of a clip; `METRICS` says what each key means and in which unit.

    Scores per frame are averaged over the frames that the truth has; `remarks` says so where it lacks some.
    What only one side has (a hand, the object) has no keys; `remarks` says which. CD_o, F5 and F10 are those
    of the first frame that the truth has, as the evaluators have it. `of_frames` is what `per_frame` gives
    for the same two, where it is known already.

    Raises:
        InputError: the two list different frames, their arrays do not fit, a value of the prediction is not
            finite, or the truth of a frame is so in part.
    """
    pred = _matched(pred, gt)
    frames = _frame_scores(pred, gt) if of_frames is None else of_frames
    scores = {key: _mean_of_finite(values) for key, values in frames.items()}
    if "rotation" in frames and np.isfinite(frames["rotation"]).any():
        # A symmetric object, or one seen end on, is turned wrongly by any angle in some frames.
        scores["rotation"] = float(np.nanmedian(frames["rotation"]))
    scores["clip_scale"] = trajectory_scale(pred, gt)
    scores |= _aligned_object_scores(pred, gt)
    return {key: scores[key] for key in METRICS if key in scores}


def check_comparable(pred: HandObjectTrajectory, gt: HandObjectTrajectory) -> None:
    """Raise what `evaluate` raises where it refuses the two, before it takes its time.

    Raises:
        InputError: see `evaluate`.
    """
    _matched(pred, gt)


def remarks(pred: HandObjectTrajectory, gt: HandObjectTrajectory) -> dict[str, str]:
    """Why scores of `evaluate` are missing, or the number of frames they cover, by key. Scores that need what
    neither side has, and scores over all frames, have no remark.
    """
    found: dict[str, str] = {}
    whole = len(gt.frame_names)
    parts = [(f"{side} hand", pred.joints.get(side), gt.joints.get(side)) for side in SIDES]
    known: dict[str, np.ndarray] = {}
    absent: dict[str, str] = {}
    for name, ours, theirs in (*parts, ("object", pred.object_verts, gt.object_verts)):
        frames = None if theirs is None else np.isfinite(theirs).all(axis=(1, 2))
        if ours is not None and frames is not None and frames.any():
            known[name] = frames
        elif ours is not None or theirs is not None:
            absent[name] = f"the {'result has no' if ours is None else 'truth has no'} {name}"
    for key in METRICS:
        needed = _parts_of(key)
        # A score of something that neither side has is not missing.
        if not needed or not all(name in known or name in absent for name in needed):
            continue
        reason = next((absent[name] for name in needed if name in absent), "")
        if reason:
            found[key] = reason
            continue
        counted = int(np.logical_and.reduce([known[name] for name in needed]).sum())
        if counted < whole and not key.endswith(_OF_ONE_FRAME):
            found[key] = f"{counted} of {whole} frames"
    return found


def _parts_of(key: str) -> list[str]:
    """What a score needs on both sides."""
    words = key.removesuffix("_sq").split("_")
    if key == "clip_scale":
        return []
    hands = {"r": ["right hand"], "l": ["left hand"], "h": ["right hand", "left hand"]}.get(words[-1], [])
    return hands + (["object"] if words[0] in ("cd", "f5", "f10", "mrrpe", "rotation") else [])


def per_frame(pred: HandObjectTrajectory, gt: HandObjectTrajectory) -> dict[str, np.ndarray]:
    """The scores that exist per frame, under the keys of `evaluate`.

    Returns:
        Arrays [T] in the truth's frame order; NaN where a side is not finite.

    Raises:
        InputError: as `evaluate`.
    """
    scores = _frame_scores(_matched(pred, gt), gt)
    return {key: scores[key] for key in METRICS if key in scores}


def trajectory_scale(pred: HandObjectTrajectory, gt: HandObjectTrajectory) -> float:
    """The one scale of the clip (see `clip_scale`): from the wrists of all frames and hands.

    The object stays out of it when there are hands: its extent and its depth are themselves unknown up to a
    scale, and an object of the wrong size would be paid for by the wrists. Without a hand that both sides
    have, the centres of the object's boxes serve.

    Args:
        pred: with the frames of `gt`, in its order.
        gt: the truth.
    """
    sides = _common_sides(pred, gt)
    if sides:
        wrists = [np.concatenate([side.joints[s][:, 0] for s in sides]) for side in (pred, gt)]
        return clip_scale(*wrists)
    if pred.object_verts is not None and gt.object_verts is not None:
        return clip_scale(_box_centres(pred.object_verts), _box_centres(gt.object_verts))
    return 1.0


def match_frames(pred_names: Sequence[str], gt_names: Sequence[str]) -> np.ndarray:
    """For each true frame the index of the prediction of that name, [T]; folders and suffixes do not count.

    Raises:
        InputError: a true frame has no prediction, a prediction has no true frame, or a name comes twice.
    """
    pred_stems, gt_stems = ([PurePath(name).stem for name in names] for names in (pred_names, gt_names))
    for what, stems in (("prediction", pred_stems), ("ground truth", gt_stems)):
        if len(set(stems)) != len(stems):
            twice = next(stem for stem in stems if stems.count(stem) > 1)
            raise InputError(f"frame names of the {what}: expected each name once, found {twice!r} again")
    where = {stem: index for index, stem in enumerate(pred_stems)}
    missing = [stem for stem in gt_stems if stem not in where]
    if missing:
        raise InputError(
            f"frame names of the prediction: expected all {len(gt_stems)} frames of the ground truth, "
            f"found no {missing[0]!r} ({len(missing)} missing)"
        )
    if len(pred_stems) != len(gt_stems):
        extra = next(stem for stem in pred_stems if stem not in set(gt_stems))
        raise InputError(
            f"frame names of the prediction: expected the {len(gt_stems)} frames of the ground truth, "
            f"found {len(pred_stems)}, among them {extra!r}"
        )
    return np.array([where[stem] for stem in gt_stems])


def comparison_table(
    rows: Mapping[str, Mapping[str, float]],
    metrics: Mapping[str, Metric] = METRICS,
    *,
    details: bool = False,
    told: Mapping[str, str] | None = None,
) -> list[tuple[str, ...]]:
    """Columns of scores side by side, as text.

    Args:
        rows: what was scored (such as "initial", "result") -> its scores, as `evaluate` gives them. Keys that
            `metrics` does not know are left out.
        metrics: the scores to show, in their order.
        details: show those that are marked so, too.
        told: what `remarks` says of some scores, which then stands behind their names.

    Returns:
        The heading ("score", "unit", names..., "change") and one tuple for each score that any of them has,
        or of which something is told; "-" where one lacks it. The last column says by how much the last
        column of scores differs from the first; it is missing when there is one column only.
    """
    compared = len(rows) > 1
    table = [("score", "unit", *rows, *(["change"] if compared else []))]
    for key, metric in metrics.items():
        if metric.detail and not details:
            continue
        values = [scores.get(key, np.nan) for scores in rows.values()]
        remark = (told or {}).get(key)
        if not np.isfinite(values).any() and remark is None:
            continue
        shown = [f"{value:.3g}" if abs(value) < 1 else f"{value:.2f}" for value in values]
        cells = [text if np.isfinite(value) else "-" for text, value in zip(shown, values, strict=True)]
        name = metric.paper if remark is None else f"{metric.paper}: {remark}"
        table.append((name, metric.unit, *cells, *([_change(metric, values)] if compared else [])))
    return table


def _change(metric: Metric, values: list[float]) -> str:
    first, last = values[0], values[-1]
    if metric.better == "neither" or not np.isfinite([first, last]).all():
        return ""
    if metric.unit == "%":
        return f"{last - first:+.1f} points"
    return f"{100.0 * (last / first - 1.0):+.0f} %" if first > 0.0 else ""


def _frame_scores(pred: HandObjectTrajectory, gt: HandObjectTrajectory) -> dict[str, np.ndarray]:
    scores: dict[str, np.ndarray] = {}
    scale = trajectory_scale(pred, gt)
    pred_object, gt_object = pred.object_verts, gt.object_verts
    sides = _common_sides(pred, gt)
    for side in sides:
        s = side[0]
        scores[f"mpjpe_ra_{s}"] = mpjpe(pred.joints[side], gt.joints[side])
        scores[f"wrist_{s}"] = wrist_error(pred.joints[side], gt.joints[side], scale)
        scores[f"wrist_unscaled_{s}"] = wrist_error(pred.joints[side], gt.joints[side])
        if pred_object is not None and gt_object is not None:
            wrists = pred.joints[side][:, 0], gt.joints[side][:, 0]
            relative = _per_frame_shape(pred_object, wrists[0], gt_object, wrists[1])
            scores[f"cd_{s}_sq"], scores[f"cd_{s}"] = relative["squared"], relative["root"]
            scores[f"f5_{s}"], scores[f"f10_{s}"] = relative["f5"], relative["f10"]
            offsets = [_box_centres(v) - w for v, w in zip((pred_object, gt_object), wrists, strict=True)]
            scores[f"mrrpe_{s}"] = 1000.0 * np.linalg.norm(offsets[0] - offsets[1], axis=-1)
    if len(sides) == len(SIDES):
        for both in ("mpjpe_ra_{}", "wrist_{}", "cd_{}_sq", "cd_{}"):
            if both.format("r") in scores:
                scores[both.format("h")] = 0.5 * (scores[both.format("r")] + scores[both.format("l")])
    if pred_object is not None and gt_object is not None:
        camera = np.zeros((len(gt.frame_names), 3))
        placed = _per_frame_shape(scale * pred_object, camera, gt_object, camera)
        scores["rotation"] = turn_errors(pred_object, gt_object)
        scores["f5_cam"], scores["f10_cam"] = placed["f5"], placed["f10"]
        centred = _per_frame_shape(pred_object, _box_centres(pred_object), gt_object, _box_centres(gt_object))
        scores["cd_ra_sq"], scores["f5_ra"], scores["f10_ra"] = (
            centred[key] for key in ("squared", "f5", "f10")
        )
    return scores


def _per_frame_shape(
    pred_object: np.ndarray, pred_origin: np.ndarray, gt_object: np.ndarray, gt_origin: np.ndarray
) -> dict[str, np.ndarray]:
    scores = relative_scores(pred_object, pred_origin, gt_object, gt_origin)
    columns = [(np.nan,) * 4 if score is None else (*score.chamfer, score.f5, score.f10) for score in scores]
    return dict(zip(("squared", "root", "f5", "f10"), np.array(columns).T, strict=True))


def _aligned_object_scores(pred: HandObjectTrajectory, gt: HandObjectTrajectory) -> dict[str, float]:
    if pred.object_verts is None or gt.object_verts is None:
        return {}
    known = np.flatnonzero(np.isfinite(gt.object_verts).all(axis=(1, 2)))
    if len(known) == 0 or not np.isfinite(pred.object_verts[known[0]]).all():
        return {}
    t = known[0]
    fit = similarity_icp(pred.object_verts[t], gt.object_verts[t], pred.object_faces, gt.object_faces).score
    return {
        "cd_icp_sq": fit.chamfer.squared,
        "cd_icp": fit.chamfer.root,
        "cd_icp_arctic": min(fit.chamfer),
        "f5_icp": fit.f5,
        "f10_icp": fit.f10,
    }


def _matched(pred: HandObjectTrajectory, gt: HandObjectTrajectory) -> HandObjectTrajectory:
    """The prediction in the truth's frame order, joints and object only: the rest is not compared."""
    for what, clip in (("prediction", pred), ("ground truth", gt)):
        n_frames = len(clip.frame_names)
        for side, joints in clip.joints.items():
            if joints is not None:
                check_shape(f"{what}: joints of the {side} hand", joints, (n_frames, 21, 3))
        if clip.object_verts is not None:
            check_shape(f"{what}: object vertices", clip.object_verts, (n_frames, "V", 3))
            if clip.object_faces is not None:
                check_faces(f"{what}: object faces", clip.object_faces, clip.object_verts.shape[1])
    for name, values in _named_points(pred):
        check_finite(f"prediction: {name}", values)
    for name, values in _named_points(gt):
        finite = np.isfinite(values).all(axis=-1)
        partly = np.flatnonzero(finite.any(axis=1) & ~finite.all(axis=1))
        if partly.size:
            point = int(np.flatnonzero(~finite[partly[0]])[0])
            raise InputError(
                f"ground truth: {name}: expected all of a frame or nothing of it, found point {point} of "
                f"frame {int(partly[0])} not finite"
            )
    order = match_frames(pred.frame_names, gt.frame_names)
    return HandObjectTrajectory(
        name=pred.name,
        frame_names=gt.frame_names,
        joints={side: joints[order] for side, joints in pred.joints.items() if joints is not None},
        verts={},
        faces={},
        object_verts=None if pred.object_verts is None else pred.object_verts[order],
        object_faces=pred.object_faces,
    )


def _named_points(clip: HandObjectTrajectory) -> list[tuple[str, np.ndarray]]:
    """All that is scored, [T, N, 3] each."""
    points = [(f"joints of the {side} hand", joints) for side, joints in clip.joints.items()]
    return [(name, v) for name, v in (*points, ("object vertices", clip.object_verts)) if v is not None]


def _common_sides(pred: HandObjectTrajectory, gt: HandObjectTrajectory) -> list[Side]:
    return [s for s in SIDES if pred.joints.get(s) is not None and gt.joints.get(s) is not None]


def _box_centres(verts: np.ndarray) -> np.ndarray:
    return 0.5 * (verts.min(axis=1) + verts.max(axis=1))


def _mean_of_finite(values: np.ndarray) -> float:
    finite = np.isfinite(values)
    return float(values[finite].mean()) if finite.any() else float("nan")

"""The steps of preprocessing that find the object's motion and put hands and object into one metric space."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from bigs.checks import InputError
from bigs.commands.preprocess.pictures import with_points, with_skeletons, write_sheet
from bigs.commands.preprocess.request import PreprocessRequest, StepOutcome, kept
from bigs.data.images import read_image, read_mask
from bigs.files import read_json
from bigs.hand import load_hand_models
from bigs.motion.models import MappingConfig
from bigs.preprocess.align import AlignConfig, align
from bigs.preprocess.artefacts import (
    ALIGNED_FILE,
    HANDS_FILE,
    MASKS,
    SFM_FILE,
    Alignment,
    FrameSet,
    ObjectSfm,
    frame_paths,
    mask_paths,
    read_alignment,
    read_depth_sigma,
    read_frame_set,
    read_hands,
    read_notes,
    read_object_sfm,
    write_alignment,
    write_frame_set,
    write_object_sfm,
)
from bigs.preprocess.hands.tracks import joints_of_track
from bigs.preprocess.object.learned_features import load_matcher
from bigs.preprocess.object.sfm import SfmConfig, SfmReport, structure_from_motion
from bigs.preprocess.stamps import content_digest, write_json
from bigs.types import Side

# What structure from motion has to say of every frame.
SFM_REPORT = "object_sfm.json"
ALIGN_REPORT = "aligned.json"


def object_step(request: PreprocessRequest, listen: Callable[[str], None]) -> StepOutcome:
    """`object_sfm.npz` from frames and masks, and its report `object_sfm.json`.

    When the focal length was only assumed, `frames.json` gets the one that was estimated.
    """
    processed = request.processed
    frames = read_frame_set(processed)
    count = len(frames.names)
    file, picture, report_file = processed / SFM_FILE, processed / "object.png", processed / SFM_REPORT
    config = SfmConfig(mapping=MappingConfig(pairs="exhaustive" if request.exhaustive else "sequential"))
    weights = _weights(request)
    state = request.state(file, _object_inputs(processed, frames, config, weights))
    if state in ("current", "supplied"):
        stored = read_notes(report_file) if state == "current" else ()
        summary = _object_summary(read_object_sfm(file, count))
        return kept("object", state, summary, picture, stored)
    matcher = load_matcher(*weights) if weights else None
    listen("finding features")
    labels = _labels(processed, frames)
    images = [read_image(path) for path in frame_paths(processed, frames)]
    found, report = structure_from_motion(
        images, labels, frames.K, config, known_focal=frames.focal_known, matcher=matcher
    )
    notes = report.sentences()
    if not frames.focal_known:
        frames, note = _with_focal(processed, frames, report.focal)
        notes.append(note)
    inputs = _object_inputs(processed, frames, config, weights)
    write_json(report_file, _report_table(report) | {"notes": notes}, inputs)
    write_object_sfm(file, found, inputs)
    _draw_object(picture, processed, frames, found)
    return StepOutcome("object", "made", _object_summary(found), tuple(notes), picture)


def align_step(request: PreprocessRequest, listen: Callable[[str], None]) -> StepOutcome:
    """`aligned.npz` from hands, object poses and masks, and how the size was found as `aligned.json`."""
    processed = request.processed
    frames = read_frame_set(processed)
    count = len(frames.names)
    file, picture = processed / ALIGNED_FILE, processed / "aligned.png"
    config = AlignConfig(shift_sigma=read_depth_sigma(processed / HANDS_FILE))
    model = "built-in" if request.hand_model is None else request.hand_model
    parts = (processed / HANDS_FILE, processed / SFM_FILE, processed / MASKS)
    inputs = content_digest(*parts, model, frames.K, asdict(config))
    state = request.state(file, inputs)
    if state in ("current", "supplied"):
        summary = _alignment_summary(
            read_alignment(file, count), read_object_sfm(processed / SFM_FILE, count)
        )
        return kept("align", state, summary, picture)
    listen("searching the object's size")
    models = load_hand_models(request.hand_model)
    hands = read_hands(processed / HANDS_FILE, count)
    sfm = read_object_sfm(processed / SFM_FILE, count)
    found, report = align(hands, sfm, _labels(processed, frames), frames.K, models, config)
    table = {
        "touching": {side: np.flatnonzero(t) for side, t in report.touching.items()},
        "factors": report.factors,
        "costs": report.costs,
        "shifts": report.shifts,
        "notes": report.notes,
    }
    write_json(processed / ALIGN_REPORT, table, inputs)
    write_alignment(file, found, inputs)
    moved = {side: replace(track, transl=found.hand_transl[side]) for side, track in hands.items()}
    joints = {side: joints_of_track(track, models[side]) for side, track in moved.items()}
    _draw_aligned(picture, processed, frames, sfm, found, joints)
    return StepOutcome("align", "made", _alignment_summary(found, sfm), report.notes, picture)


def _weights(request: PreprocessRequest) -> tuple[Path, ...]:
    """The files of DISK and LightGlue, or none."""
    if request.disk is None and request.lightglue is None:
        return ()
    if request.disk is None or request.lightglue is None:
        missing = "--disk" if request.disk is None else "--lightglue"
        raise InputError(f"learned features: expected --disk FILE and --lightglue FILE, found no {missing}")
    return request.disk, request.lightglue


def _object_inputs(processed: Path, frames: FrameSet, config: SfmConfig, weights: tuple[Path, ...]) -> str:
    pictures = frame_paths(processed, frames)
    return content_digest(
        *pictures, processed / MASKS, *weights, frames.K, frames.focal_known, asdict(config)
    )


def _labels(processed: Path, frames: FrameSet) -> np.ndarray:
    size = (frames.width, frames.height)
    return np.stack([read_mask(path, size) for path in mask_paths(processed, frames)])


def _with_focal(processed: Path, frames: FrameSet, focal: float) -> tuple[FrameSet, str]:
    """`frames.json` with the estimated focal length, and a sentence about it."""
    K = frames.K.copy()
    K[0, 0], K[1, 1] = focal, focal * K[1, 1] / K[0, 0]
    stored = read_json(processed / "frames.json")
    changed = replace(frames, K=K, camera="estimated from the object's motion")
    write_frame_set(processed, changed, str(stored.get("inputs", "")))
    note = (
        f"focal length estimated as {focal:.0f} pixels (assumed {frames.K[0, 0]:.0f}); give --focal if known"
    )
    return changed, note


def _report_table(report: SfmReport) -> dict[str, Any]:
    """The report as it is written: one row a frame."""
    checks = report.checks
    rows = [
        {
            "frame": t,
            "features": int(report.features[t]),
            "matches_with_next": int(report.neighbour_matches[t]),
            "model": int(report.model[t]),
            "observations": int(checks.observations[t]),
            "uncertainty_degrees": round(float(checks.uncertainty[t]), 3),
            "mirror_evidence": round(float(checks.mirror[t]), 1),
            "turn_cosine": round(float(checks.cosine[t]), 3),
            "flags": checks.flags[t],
        }
        for t in range(len(report.features))
    ]
    return {"models": report.models, "starts_tried": report.tried, "focal": report.focal, "frames": rows}


def _object_summary(sfm: ObjectSfm) -> str:
    count = len(sfm.valid)
    text = f"{len(sfm.points)} points, a pose in {int(sfm.valid.sum())} of {count} frames"
    doubtful = int((sfm.confidence == 0).sum())
    return f"{text}, {doubtful} of them doubtful" if doubtful else text


def _alignment_summary(alignment: Alignment, sfm: ObjectSfm) -> str:
    size = alignment.scale * float(np.ptp(sfm.points, axis=0).max())
    return f"object about {100.0 * size:.0f} cm, {np.median(alignment.object_transl[:, 2]):.2f} m away"


def _draw_object(picture: Path, processed: Path, frames: FrameSet, sfm: ObjectSfm) -> None:
    def draw(t: int, image: np.ndarray) -> np.ndarray:
        points = sfm.points @ sfm.rotations[t].T + sfm.transl[t]
        return with_points(image, points, frames.K, bool(sfm.confidence[t] > 0))

    write_sheet(picture, frame_paths(processed, frames), frames.names, draw)


def _draw_aligned(
    picture: Path,
    processed: Path,
    frames: FrameSet,
    sfm: ObjectSfm,
    found: Alignment,
    joints: dict[Side, np.ndarray],
) -> None:
    def draw(t: int, image: np.ndarray) -> np.ndarray:
        points = found.scale * sfm.points @ found.object_rotations[t].T + found.object_transl[t]
        marked = with_points(image, points, frames.K, bool(found.object_valid[t]))
        shown = {side: hand[t] for side, hand in joints.items()}
        return with_skeletons(marked, shown, dict.fromkeys(shown, True), frames.K)

    write_sheet(picture, frame_paths(processed, frames), frames.names, draw)

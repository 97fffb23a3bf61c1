"""The stage `object-motion`: object poses against the tracks in the pictures, kept beside checkpoints."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

import bigs
from bigs.atomic import atomic_write
from bigs.data.base import Clip
from bigs.geometry.arrays import float32
from bigs.models.poses import PoseErrors
from bigs.motion.given_poses import GivenPoses
from bigs.motion.tracker import TrackedMotion, track
from bigs.motion.tracker_config import TrackerConfig
from bigs.threads import side_by_side
from bigs.train.plan.config import ObjectMotionStage
from bigs.train.plan.start_config import InitialConfig
from bigs.train.start.initial import ObjectStart, object_in_camera
from bigs.types import MASK_VALUES

FILE_NAME = "object-motion.npz"


def find_object_motion(
    clip: Clip, initial: InitialConfig, stage: ObjectMotionStage, folder: Path | None
) -> TrackedMotion | None:
    """The object's motion, read from `folder` if it was found there before from the same clip.

    Args:
        clip: the loaded clip.
        initial: how its estimates are read.
        stage: see there.
        folder: keeps what was found, so that an interrupted run goes on from it; None keeps nothing.

    Returns:
        None where the clip has no object or no mask shows it.
    """
    if clip.object is None or not clip.has_pixels("object").any():
        return None
    start = object_in_camera(clip, initial)
    given = GivenPoses(
        start.rotations.double().numpy(), start.centers.double().numpy(), start.trust.double().numpy()
    )
    digest = _digest(clip, given, stage)
    kept = None if folder is None else _read(folder / FILE_NAME, digest)
    if kept is not None:
        return kept
    # Patches are compared whatever their brightness. In one exposure, white that bright frames cut off would
    # darken and lighten.
    images = side_by_side(clip.image_as_taken, range(len(clip)))
    masks = np.stack(side_by_side(clip.mask, range(len(clip)))) == MASK_VALUES["object"]
    found = track(images, masks, np.asarray(clip.K, dtype=np.float64), given, _tracker(clip, stage))
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder / FILE_NAME) as file:
            np.savez(file, digest=np.str_(digest), **found._asdict())
    return found


def _tracker(clip: Clip, stage: ObjectMotionStage) -> TrackerConfig:
    """The tracker's settings, with what the clip's exposure says of its focal length."""
    focal = stage.tracker.focal
    if clip.gains is None or focal.calibrated >= 1.0:
        return stage.tracker
    chance = min(focal.calibrated, stage.calibrated_automatic)
    return replace(stage.tracker, focal=replace(focal, calibrated=chance))


def with_motion(start: ObjectStart, motion: TrackedMotion) -> ObjectStart:
    """The object's start in the motion found; a frame is trusted as far as it is known."""
    error = turn_errors(motion)
    # An interpolated pose counts as measured where tracks know it as well as a measurement would.
    trust = np.maximum(start.trust.numpy(), np.where(error < motion.turn_sigma, 1.0, 0.0))
    doubted = motion.contradicted & (error > motion.turn_sigma)
    return start._replace(
        rotations=torch.as_tensor(motion.rotations, dtype=torch.float32),
        centers=torch.as_tensor(motion.transl, dtype=torch.float32),
        trust=torch.as_tensor(np.where(doubted, start.trust.numpy().min(), trust), dtype=start.trust.dtype),
    )


def pose_errors(motion: TrackedMotion) -> PoseErrors:
    """The poses' errors as a scene counts them."""
    turn = np.linalg.cholesky(motion.covariance[:, :3, :3])
    across = np.sqrt(np.einsum("tii->t", motion.covariance[:, 3:5, 3:5]) / 2.0)
    return PoseErrors(float32(turn), float32(across / motion.transl[:, 2]))


def turn_errors(motion: TrackedMotion) -> np.ndarray:
    """The standard deviation of each frame's turn about an axis, radians [T]."""
    return np.sqrt(np.einsum("tii->t", motion.covariance[:, :3, :3]) / 3.0)


def in_words(motion: TrackedMotion) -> str:
    """A summary for the user."""
    error = np.degrees(turn_errors(motion))
    text = (
        f"{len(motion.points)} points, rotation known to {np.median(error):.2f} degrees (given to "
        f"{np.degrees(motion.turn_sigma):.2f})"
    )
    if motion.focal != 1.0:
        text = f"{text}, focal length x {motion.focal:.3f} +- {motion.focal_sigma:.3f}"
    wrong = np.flatnonzero(motion.contradicted)
    return f"{text}, refuted in frames {', '.join(map(str, wrong))}" if len(wrong) else text


def _digest(clip: Clip, given: GivenPoses, stage: ObjectMotionStage) -> str:
    text = json.dumps([bigs.__version__, asdict(stage), np.asarray(clip.K).tolist()], sort_keys=True)
    digest = hashlib.sha256(text.encode())
    for path in (*clip.image_paths, *clip.mask_paths):
        digest.update(path.read_bytes())
    for values in given:
        digest.update(values.tobytes())
    return digest.hexdigest()[:16]


def _read(file: Path, digest: str) -> TrackedMotion | None:
    """The file's content, if it is whole and belongs to this clip and plan."""
    try:
        # Read as bytes, since numpy leaves a file open that is no archive.
        with np.load(io.BytesIO(file.read_bytes())) as stored:
            if str(stored["digest"]) != digest:
                return None
            values = {name: stored[name] for name in TrackedMotion._fields}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return TrackedMotion(**values | {name: float(values[name]) for name in _NUMBERS})


# Fields of `TrackedMotion` that are numbers.
_NUMBERS = ("turn_sigma", "focal", "focal_sigma")

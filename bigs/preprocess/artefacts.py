"""What preprocessing steps leave for each other below `CLIP/processed`.

`stamps.py` says which of these files are up to date. All poses are in the OpenCV camera frame of their time.

    frames/%04d.png, frames.json    RGB images; original names, frames a second, K and how K was found
    masks/%04d.png, masks.json      label images 0, 50 object, 150 right, 250 left; what looks wrong in them
    hands.npz                       `HandTrack` of each side, metres
    object_sfm.npz                  `ObjectSfm`, structure-from-motion units
    aligned.npz                     `Alignment`, metres
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bigs.checks import InputError, check_positive, shown
from bigs.data.base import HandTrack
from bigs.data.entries import array_entry, require
from bigs.names import check_name
from bigs.preprocess.stamps import read_stamped_json, read_stamped_npz, write_json, write_npz
from bigs.types import SIDES, Side

PROCESSED = "processed"
FRAMES, FRAMES_FILE = "frames", "frames.json"
MASKS, MASKS_FILE = "masks", "masks.json"
HANDS_FILE = "hands.npz"
SFM_FILE = "object_sfm.npz"
ALIGNED_FILE = "aligned.npz"

# No picture has more pixels on a side.
_MOST_PIXELS = 1 << 16


@dataclass(frozen=True)
class FrameSet:
    """The content of `frames.json`, about the images in `frames/`."""

    names: tuple[str, ...]  # T original names: those of files, or the video's with the frame number
    fps: float  # of the frames that were kept
    width: int
    height: int
    K: np.ndarray  # [3, 3]; pixel (column i, row j) has its centre at (i + 0.5, j + 0.5)
    camera: str  # how K was found, in words
    focal_known: bool  # K was measured; otherwise it is an assumption that may be refined
    source_frames: tuple[int, ...] = ()  # T numbers among the source's frames; () if consecutive
    source_length: int = 0  # number of frames of the source; 0 for T
    source_size: tuple[int, int] = (0, 0)  # width, height before shrinking; (0, 0) for the frames' own


@dataclass(frozen=True)
class ObjectSfm:
    """The object by structure from motion: `x_cam = rotations x + transl`, all in its own arbitrary unit."""

    rotations: np.ndarray  # [T, 3, 3] object to camera
    transl: np.ndarray  # [T, 3]
    valid: np.ndarray  # [T] bool: registered; the others are interpolated
    confidence: np.ndarray  # [T] in [0, 1]; 0 for a pose that is not to be trusted
    points: np.ndarray  # [N, 3] trimmed points, before normalisation
    colors: np.ndarray  # [N, 3] uint8
    norm_mat: np.ndarray  # [4, 4]: carries `points` to the centred cloud of unit radius, HOLD's pts.cano


@dataclass(frozen=True)
class Alignment:
    """Hands and object in one metric space: `x_cam = object_rotations (scale x) + object_transl`.

    `x` is a point of `ObjectSfm.points`. Of the hands only the translation is corrected.
    """

    scale: float  # metres per unit of structure from motion
    object_rotations: np.ndarray  # [T, 3, 3]
    object_transl: np.ndarray  # [T, 3] metres
    object_valid: np.ndarray  # [T] bool
    hand_transl: dict[Side, np.ndarray]  # [T, 3] metres, replaces that of `HandTrack`


def write_frame_set(processed: Path, frames: FrameSet, inputs: str) -> None:
    """Write `frames.json`; the images must be there already, since this file says that they are whole."""
    write_json(processed / FRAMES_FILE, asdict(frames) | {"K": frames.K.tolist()}, inputs)


def read_frame_set(processed: Path) -> FrameSet:
    """Read `frames.json`.

    Raises:
        InputError: missing, damaged, or a field is invalid.
    """
    file = processed / FRAMES_FILE
    stored = read_stamped_json(file)
    names = require(f"{file}: names", stored, "names")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise InputError(f"{file}: names: expected a list of frame names, found {shown(names)}")
    for name in names:
        check_name(f"{file}: names", name)
    size = {key: _pixels(file, stored, key) for key in ("width", "height")}
    K = array_entry(f"{file}: K", require(f"{file}: K", stored, "K"), (3, 3))
    if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.allclose(K[2], [0, 0, 1]):
        raise InputError(f"{file}: K: expected positive focal lengths over (0, 0, 1), found {K.tolist()}")
    source = {
        key: _counts(f"{file}: {key}", stored.get(key, absent), shape)
        for key, absent, shape in (
            ("source_frames", [], ("T",)),
            ("source_length", 0, ()),
            ("source_size", (0, 0), (2,)),
        )
    }
    source_width, source_height = source["source_size"].tolist()
    places, length = source["source_frames"], int(source["source_length"])
    if len(places) not in (0, len(names)) or (length not in (0, len(names)) and not len(places)):
        raise InputError(
            f"{file}: source_frames: expected one for each of {len(names)} names, found {len(places)}"
        )
    if length and len(places) and places.max() >= length:
        raise InputError(
            f"{file}: source_frames: expected numbers below the source's {length}, found {places.max()}"
        )
    return FrameSet(
        names=tuple(names),
        fps=_number(file, stored, "fps"),
        width=size["width"],
        height=size["height"],
        K=K,
        camera=str(stored.get("camera", "supplied")),
        focal_known=bool(stored.get("focal_known", True)),
        source_frames=tuple(places.tolist()),
        source_length=length,
        source_size=(source_width, source_height),
    )


def frame_paths(processed: Path, frames: FrameSet) -> list[Path]:
    """The image files [T] that go with `frames.json`.

    Raises:
        InputError: one is missing.
    """
    return _numbered(processed / FRAMES, len(frames.names))


def mask_paths(processed: Path, frames: FrameSet) -> list[Path]:
    """The label images [T], one for each frame.

    Raises:
        InputError: one is missing.
    """
    return _numbered(processed / MASKS, len(frames.names))


# Usual relative error of a hand's depth if the estimator does not state it (as for HaMeR).
USUAL_DEPTH_SIGMA = 0.04


def write_hands(
    path: Path, hands: Mapping[Side, HandTrack], inputs: str, depth_sigma: float = USUAL_DEPTH_SIGMA
) -> None:
    """Write `hands.npz`: `SIDE.global_orient` [T, 3], `SIDE.hand_pose` [T, 45], `SIDE.betas`, `SIDE.transl`,
    `SIDE.valid`, `depth_sigma`; the tracks are in the camera frame of their time."""
    arrays: dict[str, Any] = {"depth_sigma": np.float64(depth_sigma)}
    for side, track in hands.items():
        arrays |= {
            f"{side}.global_orient": track.global_orient,
            f"{side}.hand_pose": track.hand_pose.reshape(len(track.valid), 45),
            f"{side}.betas": track.betas,
            f"{side}.transl": track.transl,
            f"{side}.valid": track.valid,
        }
    write_npz(path, arrays, inputs)


def read_hands(path: Path, frames: int) -> dict[Side, HandTrack]:
    """Read `hands.npz`.

    Args:
        path: the file.
        frames: how many frames the clip has.

    Raises:
        InputError: missing, damaged, no hand in it, or a field is invalid.
    """
    stored = read_stamped_npz(path)
    sides = [side for side in SIDES if f"{side}.global_orient" in stored]
    if not sides:
        raise InputError(f"{path}: expected right.global_orient or left.global_orient, found {_some(stored)}")
    hands: dict[Side, HandTrack] = {}
    for side in sides:
        entry = _entries_of(path, stored, f"{side}.")
        hands[side] = HandTrack(
            global_orient=entry("global_orient", (frames, 3)),
            hand_pose=entry("hand_pose", (frames, 45)).reshape(frames, 15, 3),
            transl=entry("transl", (frames, 3)),
            betas=entry("betas", (10,)),
            valid=entry("valid", (frames,)).astype(bool),
        )
    return hands


def read_depth_sigma(path: Path) -> float:
    """The usual relative error of the hands' depth in `hands.npz`.

    Raises:
        InputError: missing, damaged, or not a positive number.
    """
    stored = read_stamped_npz(path)
    value = float(array_entry(f"{path}: depth_sigma", stored.get("depth_sigma", USUAL_DEPTH_SIGMA), ()))
    check_positive(f"{path}: depth_sigma", value)
    return value


def write_object_sfm(path: Path, sfm: ObjectSfm, inputs: str) -> None:
    """Write `object_sfm.npz`: `R` [T, 3, 3], `t` [T, 3] and the other fields of `ObjectSfm` by name."""
    arrays = {"R": sfm.rotations, "t": sfm.transl, "valid": sfm.valid, "confidence": sfm.confidence}
    arrays |= {"points": sfm.points, "colors": sfm.colors, "norm_mat": sfm.norm_mat}
    write_npz(path, arrays, inputs)


def read_object_sfm(path: Path, frames: int) -> ObjectSfm:
    """Read `object_sfm.npz`; colours are optional in it, grey then.

    Raises:
        InputError: missing, damaged, or a field is invalid.
    """
    stored = read_stamped_npz(path)
    entry = _entries_of(path, stored, "")
    rotations = entry("R", (frames, 3, 3))
    bad = np.flatnonzero(np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2)) > 1e-3)
    if bad.size:
        raise InputError(f"{path}: R: expected rotation matrices, found another matrix in frame {bad[0]}")
    points = entry("points", ("N", 3))
    stored_colors = stored.get("colors", np.full(points.shape, 128))
    return ObjectSfm(
        rotations=rotations,
        transl=entry("t", (frames, 3)),
        valid=entry("valid", (frames,)).astype(bool),
        confidence=entry("confidence", (frames,)),
        points=points,
        colors=array_entry(f"{path}: colors", stored_colors, (len(points), 3)).astype(np.uint8),
        norm_mat=entry("norm_mat", (4, 4)),
    )


def write_alignment(path: Path, alignment: Alignment, inputs: str) -> None:
    """Write `aligned.npz`: `scale`, `object_rotations`, `object_transl`, `object_valid`, `SIDE.transl`."""
    arrays = {
        "scale": np.float64(alignment.scale),
        "object_rotations": alignment.object_rotations,
        "object_transl": alignment.object_transl,
        "object_valid": alignment.object_valid,
    }
    write_npz(path, arrays | {f"{side}.transl": t for side, t in alignment.hand_transl.items()}, inputs)


def read_alignment(path: Path, frames: int) -> Alignment:
    """Read `aligned.npz`.

    Raises:
        InputError: missing, damaged, or a field is invalid.
    """
    stored = read_stamped_npz(path)
    entry = _entries_of(path, stored, "")
    scale = float(entry("scale", ()))
    check_positive(f"{path}: scale", scale)
    return Alignment(
        scale=scale,
        object_rotations=entry("object_rotations", (frames, 3, 3)),
        object_transl=entry("object_transl", (frames, 3)),
        object_valid=entry("object_valid", (frames,)).astype(bool),
        hand_transl={
            side: entry(f"{side}.transl", (frames, 3)) for side in SIDES if f"{side}.transl" in stored
        },
    )


def read_notes(file: Path) -> tuple[str, ...]:
    """The `notes` of a report in JSON, none where there is no such file.

    Raises:
        InputError: damaged, or its notes are no list.
    """
    if not file.exists():
        return ()
    notes = read_stamped_json(file).get("notes", [])
    if not isinstance(notes, list):
        raise InputError(f"{file}: notes: expected a list of sentences, found {type(notes).__name__}")
    return tuple(map(str, notes))


def _entries_of(path: Path, stored: Mapping[str, Any], prefix: str) -> Any:
    """A function that takes a named entry out of `stored`, checked."""

    def entry(name: str, shape: Sequence[int | str]) -> np.ndarray:
        where = f"{path}: {prefix}{name}"
        return array_entry(where, require(where, stored, prefix + name), shape)

    return entry


def _numbered(folder: Path, count: int) -> list[Path]:
    paths = [folder / f"{t:04d}.png" for t in range(count)]
    missing = [path for path in paths if not path.is_file()]
    if missing:
        raise InputError(f"{missing[0]}: expected an image for each of {count} frames, found no such file")
    return paths


def _counts(where: str, value: Any, shape: Sequence[int | str]) -> np.ndarray:
    """Whole numbers of 0 or more."""
    counts = array_entry(where, value, shape)
    if (counts < 0).any() or (counts != np.floor(counts)).any():
        raise InputError(f"{where}: expected whole numbers of 0 or more, found {shown(value)}")
    return counts.astype(int)


def _pixels(file: Path, stored: Mapping[str, Any], key: str) -> int:
    where = f"{file}: {key}"
    count = int(_counts(where, require(where, stored, key), ()))
    if not 1 <= count <= _MOST_PIXELS:
        raise InputError(f"{where}: expected 1 to {_MOST_PIXELS} pixels, found {count}")
    return count


def _number(file: Path, stored: Mapping[str, Any], key: str) -> float:
    value = float(array_entry(f"{file}: {key}", require(f"{file}: {key}", stored, key), ()))
    check_positive(f"{file}: {key}", value)
    return value


def _some(stored: Mapping[str, Any]) -> str:
    return ", ".join(list(stored)[:6]) or "no fields"

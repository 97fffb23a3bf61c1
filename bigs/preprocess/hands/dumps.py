"""Files of other hand estimators in one form: HaMeR, HOLD's dumps of it, WiLoR.

HaMeR and WiLoR predict every hand as a right one in a crop that is mirrored for a left hand, with an
assumed focal length. Only the depth of the result depends on that: with the true one the hand is moved
along its ray.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.archives import read_npz
from bigs.checks import InputError, check_shape, shown
from bigs.data.entries import array_entry, flat_entry, mapping_entry, number_entry, require
from bigs.preprocess.artefacts import FrameSet
from bigs.preprocess.frames.matching import match_count, match_names
from bigs.types import SIDES, Side
from bigs.unpickle import load_npy

# HaMeR's crops are of 256 pixels, taken with a focal length of 5000.
_CROP, _CROP_FOCAL = 256.0, 5000.0


@dataclass(frozen=True)
class ParameterDump:
    """One hand's MANO parameters; invalid frames hold anything finite."""

    rotations: np.ndarray  # [T, 16, 3, 3] wrist and full finger rotations (without a mean pose to add)
    betas: np.ndarray  # [T, 10]
    transl: np.ndarray  # [T, 3] metres, camera frame, for the focal length `K`
    valid: np.ndarray  # [T] bool
    K: np.ndarray  # [3, 3] that the estimator assumed


@dataclass(frozen=True)
class GeometryDump:
    """One hand's joints and vertices; invalid frames hold anything finite."""

    joints: np.ndarray  # [T, 21, 3] in MANO's order, then the tips, metres
    vertices: np.ndarray | None  # [T, V, 3]
    valid: np.ndarray  # [T] bool
    K: np.ndarray  # [3, 3] that the estimator assumed


Dump = ParameterDump | GeometryDump


def read_hand_dump(file: Path, frames: FrameSet, hands_mean: Mapping[Side, np.ndarray]) -> dict[Side, Dump]:
    """Read a file of another hand estimator; its layout is recognised by its fields.

    - HOLD's `v3d.npy`: `v3d.SIDE` [T, 778, 3], `j3d.SIDE` [T, 21, 3], NaN where there is no hand, `K`;
    - HOLD's `hold_fit.init.npy`, `hold_fit.slerp.npy`: SIDE -> `global_orient`, `hand_pose`, `betas`,
    `transl`; - a list of N detections as arrays (.npz, or a dictionary in .npy): `frame` (names or
      numbers), `right`, `global_orient`, `hand_pose` (matrices or axis-angle), `betas`, and either HaMeR's
      `pred_cam`, `box_center`, `box_size`, or WiLoR's `pred_cam_t_full` with `scaled_focal_length`;
      optional `score` and `mirrored`.

    Args:
        file: the file.
        frames: the clip's frames.
        hands_mean: [15, 3] of each side's model, which HOLD's poses are relative to.

    Raises:
        InputError: unreadable, of none of these layouts, or a field is invalid.
    """
    stored = _load(file)
    if any(f"j3d.{side}" in stored for side in SIDES):
        return _read_geometry(file, stored, frames)
    if "global_orient" in stored and "right" in stored:
        return _read_detections(file, stored, frames)
    if any(side in stored for side in SIDES):
        return _read_fit(file, stored, frames, hands_mean)
    found = ", ".join(map(str, list(stored)[:8])) or "no fields"
    raise InputError(
        f"{file}: expected j3d.right (v3d.npy), right.global_orient (hold_fit), or a list of detections "
        f"with right "
        f"and global_orient, found {found}"
    )


def hamer_camera(width: int, height: int) -> np.ndarray:
    """The camera [3, 3] that HaMeR and WiLoR assume of a whole picture."""
    focal = _CROP_FOCAL / _CROP * max(width, height)
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def full_image_translation(
    pred_cam: np.ndarray, box_center: np.ndarray, box_size: np.ndarray, width: int, height: int
) -> np.ndarray:
    """The position of a crop's hand in the whole picture's camera (HaMeR's `cam_crop_to_full`).

    Args:
        pred_cam: [N, 3] scale and shift in the crop, not mirrored back.
        box_center: [N, 2] pixels.
        box_size: [N] pixels.
        width, height: of the picture.

    Returns:
        [N, 3] metres, for `hamer_camera`.
    """
    scale, x, y = pred_cam.T
    across = np.maximum(box_size * scale, 1e-9)
    shift_x, shift_y = 2 * (box_center - np.array([width, height]) / 2).T / across
    focal = _CROP_FOCAL / _CROP * max(width, height)
    return np.stack([x + shift_x, y + shift_y, 2 * focal / across], axis=1)


def _load(file: Path) -> Mapping[str, Any]:
    if not file.is_file():
        raise InputError(f"{file}: expected a file of hand estimates (.npy or .npz), found nothing")
    if file.suffix == ".npz":
        return read_npz(file, "an .npz of hand estimates")
    return mapping_entry(str(file), load_npy(file))


def _frames_of(file: Path, stored: Mapping[str, Any], count: int, frames: FrameSet) -> list[int | None]:
    """For each frame its place among the file's `count`."""
    names = stored.get("im_paths")
    if names is not None and len(names) == count:
        return match_names(str(file), [PurePath(str(name)).name for name in names], frames)
    return list(match_count(str(file), count, frames))


def _rows(values: np.ndarray, places: list[int | None]) -> np.ndarray:
    """Rows of the file in the order of the frames; NaN where there is none."""
    empty = np.full(values.shape[1:], np.nan)
    return np.stack([empty if place is None else values[place] for place in places])


def _assumed(file: Path, stored: Mapping[str, Any], frames: FrameSet) -> np.ndarray:
    """The file's K at the frames' size, or what HaMeR assumes."""
    if "K" not in stored:
        return hamer_camera(frames.width, frames.height)
    width, height = frames.source_size if all(frames.source_size) else (frames.width, frames.height)
    K = array_entry(f"{file}: K", stored["K"], (3, 3))
    return np.diag([frames.width / width, frames.height / height, 1.0]) @ K


def _read_geometry(file: Path, stored: Mapping[str, Any], frames: FrameSet) -> dict[Side, Dump]:
    found: dict[Side, Dump] = {}
    for side in SIDES:
        if f"j3d.{side}" not in stored:
            continue
        joints = array_entry(f"{file}: j3d.{side}", stored[f"j3d.{side}"], ("T", 21, 3), finite=False)
        places = _frames_of(file, stored, len(joints), frames)
        joints = _rows(joints, places)
        valid = np.isfinite(joints).all((1, 2))
        vertices = None
        if f"v3d.{side}" in stored:
            vertices = array_entry(f"{file}: v3d.{side}", stored[f"v3d.{side}"], ("T", "V", 3), finite=False)
            vertices = np.nan_to_num(_rows(vertices, places))
        if valid.any():
            found[side] = GeometryDump(np.nan_to_num(joints), vertices, valid, _assumed(file, stored, frames))
    return _some(file, found)


def _read_fit(
    file: Path, stored: Mapping[str, Any], frames: FrameSet, hands_mean: Mapping[Side, np.ndarray]
) -> dict[Side, Dump]:
    found: dict[Side, Dump] = {}
    for side in SIDES:
        if side not in stored:
            continue
        where = f"{file}: {side}"
        entity = mapping_entry(where, stored[side])

        def field(key: str, width: int, where: str = where, entity: Mapping[str, Any] = entity) -> np.ndarray:
            return array_entry(
                f"{where}.{key}", require(f"{where}.{key}", entity, key), ("T", width), finite=False
            )

        count = len(field("transl", 3))
        places = _frames_of(file, stored, count, frames)
        values = {
            key: _rows(field(key, width), places)
            for key, width in (("global_orient", 3), ("hand_pose", 45), ("betas", 10), ("transl", 3))
        }
        valid = np.all([np.isfinite(rows).all(1) for rows in values.values()], axis=0)
        if "is_valid" in entity:
            flags = array_entry(f"{where}.is_valid", entity["is_valid"], (count,))
            valid &= _rows(flags[:, None], places)[:, 0] == 1
        if not valid.any():
            continue
        values = {key: np.nan_to_num(rows) for key, rows in values.items()}
        fingers = values["hand_pose"].reshape(-1, 15, 3) + hands_mean[side]
        turns = np.concatenate([values["global_orient"][:, None], fingers], axis=1)
        found[side] = ParameterDump(
            _matrices(turns), values["betas"], values["transl"], valid, _assumed(file, stored, frames)
        )
    return _some(file, found)


def _read_detections(file: Path, stored: Mapping[str, Any], frames: FrameSet) -> dict[Side, Dump]:
    right = flat_entry(f"{file}: right", stored["right"]) > 0.5
    count = len(right)

    def field(key: str, shape: tuple[int, ...]) -> np.ndarray:
        values = flat_entry(f"{file}: {key}", require(f"{file}: {key}", stored, key))
        check_shape(f"{file}: {key}, without axes", values, (count * math.prod(shape),))
        return values.reshape(count, *shape)

    turns = np.concatenate(
        [
            _as_matrices(file, stored, "global_orient", count, 1),
            _as_matrices(file, stored, "hand_pose", count, 15),
        ],
        axis=1,
    )
    width, height = frames.source_size if all(frames.source_size) else (frames.width, frames.height)
    mirror = np.array([-1.0, 1.0, 1.0])
    if "pred_cam" in stored:
        cam = field("pred_cam", (3,))
        # A left crop is mirrored, so its shift points to the other side of the picture.
        cam[~right, 1] *= -1.0
        transl = full_image_translation(
            cam, field("box_center", (2,)), field("box_size", (1,))[:, 0], width, height
        )
        K = hamer_camera(width, height)
    else:
        transl = field("pred_cam_t_full", (3,))
        where = f"{file}: scaled_focal_length"
        focal = number_entry(where, require(where, stored, "scaled_focal_length"))
        K = hamer_camera(width, height)
        K[0, 0] = K[1, 1] = focal
    # HaMeR's own output is the right hand of the mirrored crop; some wrappers mirror it back.
    mirrored = flat_entry(f"{file}: mirrored", stored.get("mirrored", "pred_cam" in stored))
    if mirrored.all():
        turns[~right] = turns[~right] * mirror[:, None] * mirror
    K = np.diag([frames.width / width, frames.height / height, 1.0]) @ K
    betas = field("betas", (10,))
    score = field("score", ()) if "score" in stored else np.ones(count)
    at = _detection_frames(file, stored, count, frames)
    found: dict[Side, Dump] = {}
    for side in SIDES:
        chosen = _one_each(at, right == (side == "right"), score, transl, len(frames.names))
        valid = chosen >= 0
        if valid.any():
            rows = np.where(valid, chosen, chosen[valid][0])
            found[side] = ParameterDump(turns[rows], betas[rows], transl[rows], valid, K)
    return _some(file, found)


def _as_matrices(file: Path, stored: Mapping[str, Any], key: str, count: int, joints: int) -> np.ndarray:
    """Rotations [N, J, 3, 3] of matrices or axis-angle."""
    values = flat_entry(f"{file}: {key}", require(f"{file}: {key}", stored, key))
    if values.size == count * joints * 9:
        return values.reshape(count, joints, 3, 3)
    if values.size == count * joints * 3:
        return _matrices(values.reshape(count, joints, 3))
    raise InputError(
        f"{file}: {key}: expected {joints} rotation matrices or axis-angle vectors for each of {count} "
        f"detections, found {values.size} values"
    )


def _matrices(turns: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(*turns.shape, 3)


def _detection_frames(file: Path, stored: Mapping[str, Any], count: int, frames: FrameSet) -> np.ndarray:
    """The frame [N] of each detection, -1 for one of a picture that was not kept."""
    named = require(f"{file}: frame", stored, "frame")
    # A list of texts stays a list: an array would pad each to the longest.
    listed = named if isinstance(named, list | tuple) else np.ravel(named).tolist()
    if len(listed) != count:
        raise InputError(f"{file}: frame: expected one for each of {count} detections, found {len(listed)}")
    places: dict[str, int] = {PurePath(name).stem: t for t, name in enumerate(frames.names)}
    if not any(isinstance(name, str) for name in listed):
        numbers = frames.source_frames or tuple(range(len(frames.names)))
        places = {str(number): t for t, number in enumerate(numbers)}
        keys = [str(int(value)) for value in flat_entry(f"{file}: frame", listed)]
    else:
        keys = [PurePath(str(value)).stem for value in listed]
    at = np.array([places.get(key, -1) for key in keys])
    if (at < 0).all():
        raise InputError(
            f"{file}: frame: expected names like {frames.names[0]} or numbers, found {shown(keys[0])}"
        )
    return at


def _one_each(
    at: np.ndarray, mine: np.ndarray, score: np.ndarray, transl: np.ndarray, frames: int
) -> np.ndarray:
    """One side's detection per frame [T], -1 for none: by score, then by distance to the previous one."""
    chosen = np.full(frames, -1)
    last: np.ndarray | None = None
    for t in range(frames):
        rows = np.flatnonzero(mine & (at == t))
        if rows.size == 0:
            continue
        rows = rows[score[rows] == score[rows].max()]
        if last is not None and len(rows) > 1:
            rays = transl[rows, :2] / transl[rows, 2:]
            rows = rows[np.linalg.norm(rays - last, axis=1).argsort()]
        chosen[t] = rows[0]
        last = transl[rows[0], :2] / transl[rows[0], 2:]
    return chosen


def _some(file: Path, found: dict[Side, Dump]) -> dict[Side, Dump]:
    if not found:
        raise InputError(f"{file}: expected a hand in at least one frame, found none")
    return found

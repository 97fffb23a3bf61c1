"""Every pose of a reconstructed clip as one npz file of plain arrays."""

from __future__ import annotations

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bigs.archives import read_npz
from bigs.atomic import atomic_write
from bigs.checks import InputError, check_finite, check_positive, check_rotations, check_shape
from bigs.types import SIDES, Side

FORMAT = "bigs-poses-2"


class HandPoses(NamedTuple):
    """One hand over the clip, in the MANO convention of its own side (nothing is mirrored).

    `x_cam = MANO(global_orient, hand_pose, betas) + transl`, where MANO turns about its rest wrist joint.
    """

    global_orient: np.ndarray  # [T, 3] axis-angle
    hand_pose: np.ndarray  # [T, 15, 3] axis-angle, relative to the model's hands_mean
    transl: np.ndarray  # [T, 3] metres
    betas: np.ndarray  # [10]
    grasp: np.ndarray  # [T] number of the grasp in which the object carries the hand, -1 for none
    grasp_certainty: np.ndarray  # [T] in [0, 1], certainty of the grasp


class ObjectPoses(NamedTuple):
    """The object over the clip: `x_cam = rotations (scale * x_canon) + transl`."""

    rotations: np.ndarray  # [T, 3, 3]
    transl: np.ndarray  # [T, 3] metres
    scale: float


class ClipPoses(NamedTuple):
    """What moves, and the camera that saw it: OpenCV camera axes, metres, radians."""

    frame_names: tuple[str, ...]  # T names, as the clip lists them
    K: np.ndarray  # [3, 3]; pixel (column i, row j) has its centre at (i + 0.5, j + 0.5)
    hands: dict[Side, HandPoses]
    object: ObjectPoses | None


def save_poses(path: str | Path, poses: ClipPoses) -> None:
    """Write the poses; `path` is whole or absent.

    The file holds `format`, `frame_names`, `K`, and per hand and object one array for each field of
    `HandPoses` and `ObjectPoses`, named like `right_global_orient` and `object_rotations`.

    Raises:
        InputError: a shape does not fit the number of frames, or a value is not finite.
    """
    arrays = {
        "format": np.array(FORMAT),
        "frame_names": np.array(poses.frame_names),
        "K": np.asarray(poses.K),
    }
    for side, hand in poses.hands.items():
        arrays |= {f"{side}_{field}": np.asarray(values) for field, values in hand._asdict().items()}
    if poses.object is not None:
        arrays |= {f"object_{field}": np.asarray(values) for field, values in poses.object._asdict().items()}
    _check(str(path), arrays)
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    with atomic_write(path) as file:
        file.write(content.getbuffer())


def load_poses(path: str | Path) -> ClipPoses:
    """Read what `save_poses` wrote.

    Raises:
        InputError: the file is missing, damaged, of another format, or has a field that does not fit.
    """
    arrays = read_npz(path, "a poses file")
    found = str(arrays.get("format", "none"))
    if found != FORMAT:
        raise InputError(f"{path}: expected format {FORMAT}, found {found}")
    _check(str(path), arrays)
    hands = {
        side: HandPoses(**{field: arrays[f"{side}_{field}"] for field in HandPoses._fields})
        for side in SIDES
        if f"{side}_global_orient" in arrays
    }
    obj = None
    if "object_rotations" in arrays:
        obj = ObjectPoses(arrays["object_rotations"], arrays["object_transl"], float(arrays["object_scale"]))
    return ClipPoses(tuple(map(str, arrays["frame_names"])), arrays["K"], hands, obj)


def _check(where: str, arrays: dict[str, np.ndarray]) -> None:
    """Check that every field exists, has its shape, and is finite."""
    if "frame_names" not in arrays:
        raise InputError(f"{where}: expected a field frame_names, found {', '.join(arrays)}")
    check_shape(f"{where}: frame_names", arrays["frame_names"], ("T",))
    frames = len(arrays["frame_names"])
    shapes: dict[str, tuple[int, ...]] = {"K": (3, 3)}
    for side in SIDES:
        if any(key.startswith(f"{side}_") for key in arrays):
            fields = {"global_orient": (frames, 3), "hand_pose": (frames, 15, 3), "transl": (frames, 3)}
            shapes |= {f"{side}_{field}": shape for field, shape in fields.items()}
            shapes |= {
                f"{side}_betas": (10,),
                f"{side}_grasp": (frames,),
                f"{side}_grasp_certainty": (frames,),
            }
    if any(key.startswith("object_") for key in arrays):
        shapes |= {"object_rotations": (frames, 3, 3), "object_transl": (frames, 3), "object_scale": ()}
    for key, shape in shapes.items():
        if key not in arrays:
            raise InputError(f"{where}: expected a field {key}, found {', '.join(arrays)}")
        check_shape(f"{where}: {key}", arrays[key], shape)
        if arrays[key].dtype.kind not in "fiu":
            raise InputError(f"{where}: {key}: expected numbers, found dtype {arrays[key].dtype}")
        check_finite(f"{where}: {key}", arrays[key])
    if "object_rotations" in shapes:
        check_rotations(f"{where}: object_rotations", arrays["object_rotations"])
        check_positive(f"{where}: object_scale", float(arrays["object_scale"]))

"""`transforms.json` as instant-ngp, nerfstudio and Blender's exporters for NeRF write it.

Each frame has `transform_matrix`, camera to world with OpenGL camera axes (x right, y up, looking along -z).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bigs.checks import InputError, check_pixels, shown
from bigs.data.entries import array_entry, mapping_entry, number_entry, require
from bigs.files import read_json

CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])

_PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "PERSPECTIVE")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
# Rotations in such files are printed with six digits or more.
_RIGID_TOLERANCE = 1e-4

# At most this many pictures of this many pixels are rendered: an hour, and half a gigabyte.
MOST_CAMERAS, MOST_PIXELS = 10_000, 7680 * 4320


class RenderCamera(NamedTuple):
    """One picture to render."""

    frame_index: int  # time of the clip
    viewmat: np.ndarray  # [4, 4] world to camera, OpenCV axes
    K: np.ndarray  # [3, 3]; pixel (column i, row j) has its centre at (i + 0.5, j + 0.5)
    width: int
    height: int


class PlacedCamera(NamedTuple):
    """A frame of the file: where its camera stood, and all that the file says of it."""

    where: str  # names it in messages
    entry: Mapping[str, Any]
    viewmat: np.ndarray  # [4, 4] world to camera, OpenCV axes
    K: np.ndarray  # [3, 3]
    width: int
    height: int


def read_cameras(path: str | Path) -> list[PlacedCamera]:
    """The cameras of a `transforms.json` as they stand, whatever their frames are called.

    Raises:
        InputError: not JSON, a missing field, distortion, or a matrix that is not rigid.
    """
    path = Path(path)
    return cameras_in(path, mapping_entry(str(path), read_json(path)))


def cameras_in(
    path: Path, document: Mapping[str, Any], size: tuple[int, int] | None = None
) -> list[PlacedCamera]:
    """The cameras of what a `transforms.json` holds; `size` is that of frames that name none.

    Raises:
        InputError: as `read_cameras`.
    """
    frames = require(f"{path}: frames", document, "frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames: expected a list of cameras, found {shown(frames)}")
    check_cameras(f"{path}: frames", len(frames))
    cameras = []
    for index, stored in enumerate(frames):
        where = f"{path}: frames[{index}]"
        entry = mapping_entry(where, stored)
        # A frame's own lens overrides the file's.
        values = {**document, **entry}
        _check_lens(where, values)
        width, height = size_field(f"{where}.", values, "w", "h", size)
        K = _intrinsics(where, values, width, height)
        matrix = require(f"{where}.transform_matrix", entry, "transform_matrix")
        viewmat = viewmat_field(f"{where}.transform_matrix", matrix)
        cameras.append(PlacedCamera(where, entry, viewmat, K, width, height))
    return cameras


def write_transforms(path: str | Path, cameras: Sequence[RenderCamera]) -> None:
    """Write `cameras` so that `render_cameras.load_cameras` returns them; each frame has its intrinsics."""
    frames = [
        {
            "file_path": f"{index:04d}.png",
            "frame_index": camera.frame_index,
            "w": camera.width,
            "h": camera.height,
            "fl_x": float(camera.K[0, 0]),
            "fl_y": float(camera.K[1, 1]),
            "cx": float(camera.K[0, 2]),
            "cy": float(camera.K[1, 2]),
            "transform_matrix": (np.linalg.inv(camera.viewmat) @ CV_FROM_GL).tolist(),
        }
        for index, camera in enumerate(cameras)
    ]
    Path(path).write_text(json.dumps({"camera_model": "PINHOLE", "frames": frames}, indent=1) + "\n")


def _check_lens(where: str, values: Mapping[str, Any]) -> None:
    model = values.get("camera_model", "PINHOLE")
    if model not in _PINHOLE_MODELS:
        raise InputError(
            f"{where}.camera_model: expected one of {', '.join(_PINHOLE_MODELS)}, found {model!r}"
        )
    for key in _DISTORTION:
        if key in values and number_entry(f"{where}.{key}", values[key]) != 0:
            raise InputError(f"{where}.{key}: expected a camera without distortion, found {values[key]}")


def _intrinsics(where: str, values: Mapping[str, Any], width: int, height: int) -> np.ndarray:
    fl_x = _focal(where, values, "fl_x", "camera_angle_x", width)
    if fl_x is None:
        raise InputError(f"{where}.fl_x: expected fl_x or camera_angle_x, found neither")
    fl_y = _focal(where, values, "fl_y", "camera_angle_y", height)
    cx = number_entry(f"{where}.cx", values.get("cx", width / 2))
    cy = number_entry(f"{where}.cy", values.get("cy", height / 2))
    return np.array([[fl_x, 0.0, cx], [0.0, fl_x if fl_y is None else fl_y, cy], [0.0, 0.0, 1.0]])


def _focal(where: str, values: Mapping[str, Any], key: str, angle_key: str, pixels: int) -> float | None:
    """The focal length in pixels, from itself or from the field of view; None if the file gives neither."""
    if key in values:
        focal = number_entry(f"{where}.{key}", values[key])
        if focal <= 0:
            raise InputError(f"{where}.{key}: expected a positive focal length, found {focal:g}")
        return focal
    if angle_key in values:
        angle = number_entry(f"{where}.{angle_key}", values[angle_key])
        if not 0 < angle < math.pi:
            raise InputError(f"{where}.{angle_key}: expected an angle between 0 and pi, found {angle:g}")
        return 0.5 * pixels / math.tan(0.5 * angle)
    return None


def size_field(
    prefix: str, values: Mapping[str, Any], width_key: str, height_key: str, size: tuple[int, int] | None
) -> tuple[int, int]:
    """Width and height of a picture; `size` where neither is named. `prefix` goes before the keys."""
    if size is not None and width_key not in values and height_key not in values:
        return size
    width, height = (count_field(f"{prefix}{key}", values, key, 1) for key in (width_key, height_key))
    check_pixels(f"{prefix}{width_key}", width, height, MOST_PIXELS)
    return width, height


def check_cameras(where: str, count: int) -> None:
    """Raise `InputError` if there are more cameras than are rendered in one go."""
    if count > MOST_CAMERAS:
        raise InputError(f"{where}: expected at most {MOST_CAMERAS} cameras, found {count}")


def viewmat_field(where: str, stored: Any) -> np.ndarray:
    """World to camera in OpenCV axes [4, 4], from four rows of camera to world in OpenGL axes."""
    try:
        matrix = np.asarray(stored)
    except ValueError:  # rows of different lengths
        raise InputError(f"{where}: expected a 4 x 4 matrix, found {shown(stored)}") from None
    world_from_gl = array_entry(where, matrix, (4, 4))
    rotation = world_from_gl[:3, :3]
    is_rigid = np.allclose(rotation.T @ rotation, np.eye(3), atol=_RIGID_TOLERANCE)
    if not is_rigid or np.linalg.det(rotation) < 0 or not np.allclose(world_from_gl[3], [0, 0, 0, 1]):
        raise InputError(f"{where}: expected a rigid motion, found {world_from_gl.tolist()}")
    return np.linalg.inv(world_from_gl @ CV_FROM_GL)


def count_field(where: str, values: Mapping[str, Any], key: str, least: int) -> int:
    """A whole number of at least `least`; instant-ngp writes sizes as 1080.0."""
    number = number_entry(where, require(where, values, key))
    if number != int(number) or number < least:
        raise InputError(f"{where}: expected a whole number of at least {least}, found {number:g}")
    return int(number)

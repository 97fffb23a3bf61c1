"""Cameras to render from: `transforms.json` as instant-ngp and nerfstudio write it.

Each frame has `frame_index`, the time of the clip to show, and `transform_matrix`, camera to world with
OpenGL camera axes (x right, y up, looking along -z). World is the camera frame of that time, OpenCV axes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bigs.checks import InputError
from bigs.data.fields import array_field, mapping_field, read_json, require

CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])

_PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "PERSPECTIVE")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
# Rotations in such files are printed with six digits or more.
_RIGID_TOLERANCE = 1e-4


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


def load_transforms(path: str | Path, *, frame_count: int | None = None) -> list[RenderCamera]:
    """Read the cameras of a `transforms.json`, in the file's order.

    Args:
        path: the file.
        frame_count: how many frames the clip has; a larger `frame_index` is then an error.

    Raises:
        InputError: not JSON, a missing field, distortion, a matrix that is not rigid, a frame out of range.
    """
    cameras = []
    for camera in read_cameras(path):
        frame_index = _count(camera.where, camera.entry, "frame_index", 0)
        if frame_count is not None and frame_index >= frame_count:
            raise InputError(
                f"{camera.where}.frame_index: expected at most {frame_count - 1}, the clip's last frame, "
                f"found {frame_index}"
            )
        cameras.append(RenderCamera(frame_index, camera.viewmat, camera.K, camera.width, camera.height))
    return cameras


def read_cameras(path: str | Path) -> list[PlacedCamera]:
    """The cameras of a `transforms.json` as they stand, whatever their frames are called.

    Raises:
        InputError: as `load_transforms`.
    """
    path = Path(path)
    document = mapping_field(str(path), read_json(path))
    frames = require(f"{path}: frames", document, "frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames: expected a list of cameras, found {_brief(frames)}")
    cameras = []
    for index, stored in enumerate(frames):
        where = f"{path}: frames[{index}]"
        entry = mapping_field(where, stored)
        # What a frame says about its lens overrides what the file says for all.
        values = {**document, **entry}
        _check_lens(where, values)
        width, height = _count(where, values, "w", 1), _count(where, values, "h", 1)
        K = _intrinsics(where, values, width, height)
        cameras.append(PlacedCamera(where, entry, _viewmat(where, entry), K, width, height))
    return cameras


def write_transforms(path: str | Path, cameras: Sequence[RenderCamera]) -> None:
    """Write `cameras` so that `load_transforms` returns them; intrinsics are stored with each frame."""
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
        if key in values and _number(f"{where}.{key}", values[key]) != 0:
            raise InputError(f"{where}.{key}: expected a camera without distortion, found {values[key]}")


def _intrinsics(where: str, values: Mapping[str, Any], width: int, height: int) -> np.ndarray:
    fl_x = _focal(where, values, "fl_x", "camera_angle_x", width)
    if fl_x is None:
        raise InputError(f"{where}.fl_x: expected fl_x or camera_angle_x, found neither")
    fl_y = _focal(where, values, "fl_y", "camera_angle_y", height)
    cx = _number(f"{where}.cx", values.get("cx", width / 2))
    cy = _number(f"{where}.cy", values.get("cy", height / 2))
    return np.array([[fl_x, 0.0, cx], [0.0, fl_x if fl_y is None else fl_y, cy], [0.0, 0.0, 1.0]])


def _focal(where: str, values: Mapping[str, Any], key: str, angle_key: str, pixels: int) -> float | None:
    """The focal length in pixels, from itself or from the field of view; None if the file gives neither."""
    if key in values:
        focal = _number(f"{where}.{key}", values[key])
        if focal <= 0:
            raise InputError(f"{where}.{key}: expected a positive focal length, found {focal:g}")
        return focal
    if angle_key in values:
        angle = _number(f"{where}.{angle_key}", values[angle_key])
        if not 0 < angle < math.pi:
            raise InputError(f"{where}.{angle_key}: expected an angle between 0 and pi, found {angle:g}")
        return 0.5 * pixels / math.tan(0.5 * angle)
    return None


def _viewmat(where: str, entry: Mapping[str, Any]) -> np.ndarray:
    where = f"{where}.transform_matrix"
    stored = require(where, entry, "transform_matrix")
    try:
        matrix = np.asarray(stored)
    except ValueError:  # rows of different lengths
        raise InputError(f"{where}: expected a 4 x 4 matrix, found {_brief(stored)}") from None
    world_from_gl = array_field(where, matrix, (4, 4))
    rotation = world_from_gl[:3, :3]
    is_rigid = np.allclose(rotation.T @ rotation, np.eye(3), atol=_RIGID_TOLERANCE)
    if not is_rigid or np.linalg.det(rotation) < 0 or not np.allclose(world_from_gl[3], [0, 0, 0, 1]):
        raise InputError(f"{where}: expected a rigid motion, found {world_from_gl.tolist()}")
    return np.linalg.inv(world_from_gl @ CV_FROM_GL)


def _count(where: str, values: Mapping[str, Any], key: str, least: int) -> int:
    """A whole number of at least `least`; instant-ngp writes sizes as 1080.0."""
    number = _number(f"{where}.{key}", require(f"{where}.{key}", values, key))
    if number != int(number) or number < least:
        raise InputError(f"{where}.{key}: expected a whole number of at least {least}, found {number:g}")
    return int(number)


def _number(where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{where}: expected a number, found {_brief(value)}")
    return float(value)


def _brief(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."

"""Cameras to render from, in the forms that other programs write, and the time of the clip that each shows.

Two kinds of file are read: `transforms.json` (instant-ngp, nerfstudio, Blender's exporters for NeRF) and the
camera path that nerfstudio's viewer saves. Both place cameras with OpenGL axes in a world of their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bigs.checks import InputError
from bigs.data.entries import mapping_entry, number_entry, positive_entry, require
from bigs.data.formats.transforms import (
    PlacedCamera,
    RenderCamera,
    cameras_in,
    check_cameras,
    count_field,
    size_field,
    viewmat_field,
)
from bigs.files import read_json


class CameraPath(NamedTuple):
    """Pictures to render, in order."""

    cameras: list[RenderCamera]
    fps: float | None  # frames per second, if the file has it


def load_cameras(
    path: str | Path,
    *,
    frame_count: int,
    time_of: Callable[[int], int] | None = None,
    size: tuple[int, int] | None = None,
) -> CameraPath:
    """Read the cameras of a file, in its order.

    Args:
        path: a `transforms.json` or a camera path.
        frame_count: how many frames the clip has.
        time_of: the frame of the clip that the i-th picture shows, for a file that does not say it; without
            it each camera must have a `frame_index`.
        size: width and height of cameras that name none.

    Raises:
        InputError: not JSON, a missing field, a camera that is no pinhole, a matrix that is not rigid, a
            frame out of range, or a time that is given twice.
    """
    path = Path(path)
    document = mapping_entry(str(path), read_json(path))
    fps = None
    if "camera_path" in document:
        placed = _path_cameras(path, document, size)
        if "fps" in document:
            fps = positive_entry(f"{path}: fps", document["fps"])
    else:
        placed = cameras_in(path, document, size)
    times = _times(placed, frame_count, time_of)
    cameras = [
        RenderCamera(time, camera.viewmat, camera.K, camera.width, camera.height)
        for time, camera in zip(times, placed, strict=True)
    ]
    return CameraPath(cameras, fps)


def _times(
    cameras: Sequence[PlacedCamera], frame_count: int, time_of: Callable[[int], int] | None
) -> list[int]:
    times = []
    for index, camera in enumerate(cameras):
        where, told = f"{camera.where}.frame_index", "frame_index" in camera.entry
        if time_of is not None and told:
            raise InputError(f"{where}: expected none beside --frame or --play, found one")
        if time_of is None and not told:
            raise InputError(
                f"{where}: expected this field, or the time to show as --frame N or --play, found neither"
            )
        time = count_field(where, camera.entry, "frame_index", 0) if time_of is None else time_of(index)
        if time >= frame_count:
            raise InputError(
                f"{where}: expected at most {frame_count - 1}, the clip's last frame, found {time}"
            )
        times.append(time)
    return times


def _path_cameras(
    path: Path, document: Mapping[str, Any], size: tuple[int, int] | None
) -> list[PlacedCamera]:
    kind = document.get("camera_type", "perspective")
    if kind != "perspective":
        raise InputError(f"{path}: camera_type: expected perspective, found {kind!r}")
    stored = document["camera_path"]
    if not isinstance(stored, list) or not stored:
        raise InputError(f"{path}: camera_path: expected a list of cameras, found {type(stored).__name__}")
    check_cameras(f"{path}: camera_path", len(stored))
    width, height = size_field(f"{path}: ", document, "render_width", "render_height", size)
    cameras = []
    for index, entry in enumerate(stored):
        where = f"{path}: camera_path[{index}]"
        entry = mapping_entry(where, entry)
        matrix = require(f"{where}.camera_to_world", entry, "camera_to_world")
        viewmat = viewmat_field(f"{where}.camera_to_world", _rows(f"{where}.camera_to_world", matrix))
        fov = number_entry(f"{where}.fov", require(f"{where}.fov", entry, "fov"))
        if not 0 < fov < 180:
            raise InputError(f"{where}.fov: expected degrees between 0 and 180, found {fov:g}")
        focal = 0.5 * height / math.tan(0.5 * math.radians(fov))
        K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        cameras.append(PlacedCamera(where, entry, viewmat, K, width, height))
    return cameras


def _rows(where: str, stored: Any) -> list[list[Any]]:
    """Sixteen numbers, row by row, as four rows."""
    if not isinstance(stored, list) or len(stored) != 16:
        found = f"{len(stored)}" if isinstance(stored, list) else type(stored).__name__
        raise InputError(f"{where}: expected a list of 16 numbers, found {found}")
    return [stored[at : at + 4] for at in range(0, 16, 4)]

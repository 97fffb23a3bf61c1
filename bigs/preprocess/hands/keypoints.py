"""Keypoints of hands as JSON, from whatever detector: 21 points of each hand in each frame.

    {"order": "openpose", "frames": [{"right": [[x, y, confidence], ...], "left": null}, ...]}

`frames` is a list in frame order or a dictionary by frame name. `order` is "openpose" (wrist, then four
points of each of thumb, index, middle, ring, pinky, as MediaPipe has them too) or "mano" (16 joints in
MANO's order, then the tips of thumb, index, middle, ring, pinky). Coordinates are pixels, with the centre
of the first pixel at `pixel_center` (0.5 if not given). `width` and `height`, where given, say in which
image size they were measured.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bigs.atomic import atomic_write
from bigs.checks import InputError, check_choice
from bigs.data.entries import array_entry, mapping_entry, require
from bigs.files import read_json
from bigs.preprocess.artefacts import FrameSet
from bigs.preprocess.frames.matching import match_count, match_names
from bigs.types import SIDES, Side

JOINTS = 21
# Positions of MANO's joints and the tips in the order that begins with the thumb.
_FROM_OPENPOSE = (0, 5, 6, 7, 9, 10, 11, 17, 18, 19, 13, 14, 15, 1, 2, 3, 4, 8, 12, 16, 20)
ORDERS: dict[str, tuple[int, ...]] = {"openpose": _FROM_OPENPOSE, "mano": tuple(range(JOINTS))}


@dataclass(frozen=True)
class Keypoints:
    """One hand's keypoints in the order of `HandModel`'s joints."""

    points: np.ndarray  # [T, 21, 2] pixels, the first pixel's centre at 0.5; 0 where not seen
    confidence: np.ndarray  # [T, 21] in [0, 1]; 0 where not seen


def read_keypoints(file: Path, frames: FrameSet) -> dict[Side, Keypoints]:
    """Read a keypoint file.

    Returns:
        The hands that are seen in any frame.

    Raises:
        InputError: unreadable, not in the documented layout, no hand at all, or another number of frames.
    """
    stored = _read(file)
    order = require(f"{file}: order", stored, "order")
    check_choice(f"{file}: order", order, ORDERS)
    rows = require(f"{file}: frames", stored, "frames")
    if isinstance(rows, Mapping):
        names = list(rows)
        chosen = match_names(f"{file}: frames", names, frames)
        entries = [(names[i], rows[names[i]]) if i is not None else ("", {}) for i in chosen]
    elif isinstance(rows, list):
        entries = [(str(i), rows[i]) for i in match_count(f"{file}: frames", len(rows), frames)]
    else:
        raise InputError(f"{file}: frames: expected a list or a dictionary, found {type(rows).__name__}")
    scale, shift = frame_pixels(file, stored, frames)
    found: dict[Side, Keypoints] = {}
    for side in SIDES:
        table = np.stack([_hand(f"{file}: frames.{name}.{side}", entry, side) for name, entry in entries])
        table = table[:, list(ORDERS[order])]
        confidence = np.clip(table[..., 2], 0.0, 1.0)
        points = np.where(confidence[..., None] > 0, (table[..., :2] + shift) * scale, 0.0)
        if confidence.any():
            found[side] = Keypoints(points, confidence)
    if not found:
        raise InputError(
            f"{file}: frames: expected keypoints of a right or left hand, found none in any frame"
        )
    return found


def write_keypoints(file: Path, keypoints: Mapping[Side, Keypoints], frames: FrameSet) -> None:
    """Write keypoints in the layout that `read_keypoints` reads, in MANO's order."""
    rows: dict[str, Any] = {}
    for t, name in enumerate(frames.names):
        rows[name] = {
            side: np.column_stack([hand.points[t], hand.confidence[t]]).round(3).tolist()
            for side, hand in keypoints.items()
            if hand.confidence[t].any()
        }
    content = {"order": "mano", "width": frames.width, "height": frames.height, "frames": rows}
    with atomic_write(file) as stream:
        stream.write(json.dumps(content).encode())


def _read(file: Path) -> Mapping[str, Any]:
    return mapping_entry(str(file), read_json(file, "a keypoint file"))


def frame_pixels(file: Path, stored: Mapping[str, Any], frames: FrameSet) -> tuple[np.ndarray, float]:
    """The factor [2] and the shift that carry the file's coordinates to the frames' pixels."""

    def number(key: str, default: float) -> float:
        return float(array_entry(f"{file}: {key}", stored.get(key, default), ()))

    width, height = frames.source_size if all(frames.source_size) else (frames.width, frames.height)
    size = np.array([number("width", width), number("height", height)])
    if size.min() <= 0:
        raise InputError(f"{file}: width, height: expected positive numbers, found {size.tolist()}")
    scale = np.array([frames.width, frames.height]) / size
    if abs(scale[0] / scale[1] - 1) > 0.02:
        raise InputError(
            f"{file}: width, height: expected the proportions of {frames.width} x {frames.height}, "
            f"found {size[0]:g} x {size[1]:g}"
        )
    return scale, 0.5 - number("pixel_center", 0.5)


def _hand(where: str, entry: Any, side: Side) -> np.ndarray:
    """One hand [21, 3] in the file's order; zeros where there is none."""
    points = mapping_entry(where, entry).get(side)
    if points is None or (isinstance(points, list) and not points):
        return np.zeros((JOINTS, 3))
    rows = [[0.0, 0.0, 0.0] if row is None else row for row in points] if isinstance(points, list) else points
    try:
        table = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(
            f"{where}: expected {JOINTS} rows of x, y, confidence, found {str(rows)[:40]}"
        ) from None
    if table.shape == (JOINTS, 2):
        table = np.column_stack([table, np.ones(JOINTS)])
    table = array_entry(where, table, (JOINTS, 3), finite=False)
    table[~np.isfinite(table).all(axis=1)] = 0.0
    return table

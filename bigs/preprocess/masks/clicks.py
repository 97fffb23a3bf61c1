"""Where things are in a few frames: clicks and boxes from a small JSON file, or from a hand's keypoints.

    {"frames": {"0": {"object": {"points": [[x, y, 1], [x, y, 0]], "box": [x0, y0, x1, y1]},
                      "right": {...}, "left": {...}}}}

A frame is named by its file or by its number in the source. A point with 1 lies on the thing, one with 0
does not. Coordinates are pixels of the source, or of an image of `width` x `height` where the file names
these.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import Any, NamedTuple, cast

import numpy as np

from bigs.checks import InputError, check_choice
from bigs.data.entries import array_entry, mapping_entry, require
from bigs.files import read_json
from bigs.preprocess.artefacts import FrameSet
from bigs.preprocess.hands.keypoints import Keypoints, frame_pixels
from bigs.types import ENTITIES, MASK_VALUES, Entity, Side

# A hand's box extends this far beyond its joints, as a share of its size, to include flesh.
_BEYOND = 0.12
# Wrist and knuckles lie well inside a hand.
_INSIDE = (0, 1, 4, 7, 10)


class Click(NamedTuple):
    """What is known of one thing in one frame, in pixels of the frames."""

    frame: int
    points: np.ndarray  # [N, 2]
    on: np.ndarray  # [N] bool: the point lies on the thing
    box: np.ndarray | None  # [4] x0, y0, x1, y1


def read_clicks(file: Path, frames: FrameSet) -> dict[Entity, list[Click]]:
    """Read a file of clicks.

    Raises:
        InputError: unreadable, not in the documented layout, a frame that is not there, or a point outside.
    """
    stored = mapping_entry(str(file), read_json(file, "a file of clicks"))
    scale, _ = frame_pixels(file, stored, frames)
    found: dict[Entity, list[Click]] = {}
    rows = mapping_entry(f"{file}: frames", require(f"{file}: frames", stored, "frames"))
    for name, entry in rows.items():
        where = f"{file}: frames.{name}"
        frame = _frame(where, name, frames)
        for entity, prompt in mapping_entry(where, entry).items():
            check_choice(where, entity, ENTITIES)
            click = _click(f"{where}.{entity}", prompt, frame, scale, frames)
            found.setdefault(cast(Entity, entity), []).append(click)
    if not found:
        raise InputError(f"{file}: frames: expected clicks on the object or a hand, found none")
    return {entity: sorted(clicks, key=lambda click: click.frame) for entity, clicks in found.items()}


def clicks_of_hand(keypoints: Keypoints, size: tuple[int, int]) -> Click:
    """A box and a few points on a hand in the frame where its keypoints are surest.

    Args:
        keypoints: of one hand.
        size: width and height of the frames.
    """
    frame = int(keypoints.confidence.sum(1).argmax())
    seen = keypoints.confidence[frame] > 0
    points = keypoints.points[frame][seen]
    margin = _BEYOND * np.ptp(points, axis=0).max()
    box = np.concatenate([points.min(0) - margin, points.max(0) + margin])
    inside = np.array([j for j in _INSIDE if seen[j]], dtype=int)
    edge = np.array([*size, *size], dtype=np.float64)
    return Click(frame, keypoints.points[frame][inside], np.ones(len(inside), bool), np.clip(box, 0.0, edge))


def add_hand_clicks(
    clicks: Mapping[Entity, list[Click]], keypoints: Mapping[Side, Keypoints], frames: FrameSet
) -> dict[Entity, list[Click]]:
    """The clicks, and for each hand that has none those of its keypoints."""
    size = (frames.width, frames.height)
    hands: dict[Entity, list[Click]] = {
        side: [clicks_of_hand(hand, size)] for side, hand in keypoints.items() if side not in clicks
    }
    both = {**clicks, **hands}
    return {entity: both[entity] for entity in MASK_VALUES if entity in both}


def _frame(where: str, name: str, frames: FrameSet) -> int:
    """The number of the kept frame that is called so."""
    stems = [PurePath(frame).stem for frame in frames.names]
    if PurePath(name).stem in stems:
        return stems.index(PurePath(name).stem)
    places = frames.source_frames or tuple(range(len(stems)))
    if name.isdigit() and int(name) in places:
        return places.index(int(name))
    raise InputError(
        f"{where}: expected the name of a frame ({stems[0]} to {stems[-1]}) or its number in the source "
        f"({places[0]} to {places[-1]}), found {name!r}"
    )


def _click(where: str, prompt: Any, frame: int, scale: np.ndarray, frames: FrameSet) -> Click:
    prompt = mapping_entry(where, prompt)
    unknown = set(prompt) - {"points", "box"}
    if unknown or not prompt:
        raise InputError(f"{where}: expected points or box, found {', '.join(sorted(unknown)) or 'neither'}")
    table = np.zeros((0, 3))
    if prompt.get("points"):
        table = array_entry(f"{where}.points", prompt["points"], ("N", 3))
        if not np.isin(table[:, 2], (0, 1)).all():
            raise InputError(f"{where}.points: expected rows of x, y and 1 (on it) or 0 (not), found others")
    points = table[:, :2] * scale
    box = None
    if prompt.get("box") is not None:
        box = array_entry(f"{where}.box", prompt["box"], (4,)) * np.tile(scale, 2)
        if box[0] >= box[2] or box[1] >= box[3]:
            raise InputError(
                f"{where}.box: expected x0 y0 x1 y1 with x0 < x1 and y0 < y1, found {box.tolist()}"
            )
    if box is None and not (table[:, 2] == 1).any():
        raise InputError(f"{where}: expected a box or a point on it, found only points beside it")
    outside = (points < 0).any(1) | (points > [frames.width, frames.height]).any(1)
    if outside.any():
        raise InputError(
            f"{where}.points: expected points within the picture, found {table[outside][0, :2].tolist()}"
        )
    return Click(frame, points, table[:, 2] == 1, box)

"""A picture to check for every step of preprocessing: a few frames with what was found drawn on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from bigs.data.base import Clip
from bigs.data.images import read_image
from bigs.geometry.spread import spread
from bigs.hand import HandModel
from bigs.hand.model import MANO_PARENTS
from bigs.preprocess.hands.tracks import joints_of_track
from bigs.types import MASK_VALUES, SIDES, Entity, Side
from bigs.viewer.preview import contact_sheet, save_picture

_COLUMNS = 6
_ROWS = 3
_CELL = 320
COLORS: dict[Entity, tuple[int, int, int]] = {
    "right": (230, 90, 60),
    "left": (60, 120, 230),
    "object": (60, 190, 90),
}
_MISSING = (150, 150, 150)
# Bones between the 21 joints: the tree of MANO, and each tip on its finger's last joint.
BONES = (
    *((p, j) for j, p in enumerate(MANO_PARENTS) if p >= 0),
    (15, 16),
    (3, 17),
    (6, 18),
    (12, 19),
    (9, 20),
)


def write_sheet(
    file: Path, images: Sequence[Path], names: Sequence[str], draw: Callable[[int, np.ndarray], np.ndarray]
) -> None:
    """A sheet of frames spread over the clip, each as `draw` makes it from its number and its pixels."""
    chosen = spread(len(images), _COLUMNS * _ROWS)
    rows: list[Image.Image] = []
    for start in range(0, len(chosen), _COLUMNS):
        frames = chosen[start : start + _COLUMNS]
        cells = [draw(int(t), read_image(images[t])) for t in frames]
        captions = [f"{t}: {Path(names[t]).stem}" for t in frames]
        padding = [None] * (_COLUMNS - len(frames))
        rows.append(
            contact_sheet({" ": [*cells, *padding]}, [*captions, *([""] * len(padding))], cell_width=_CELL)
        )
    sheet = Image.new("RGB", (rows[0].width, sum(row.height for row in rows)), (255, 255, 255))
    top = 0
    for row in rows:
        sheet.paste(row, (0, top))
        top += row.height
    save_picture(file, sheet)


def tinted(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The image with each entity of its label mask in a colour of its own."""
    mixed = image.astype(np.float64)
    for entity, value in MASK_VALUES.items():
        mixed[mask == value] = 0.45 * mixed[mask == value] + 0.55 * np.array(COLORS[entity])
    return mixed.round().astype(np.uint8)


def with_skeletons(
    image: np.ndarray, joints: Mapping[Side, np.ndarray], valid: Mapping[Side, bool], K: np.ndarray
) -> np.ndarray:
    """The image with the bones of each hand; grey where a frame has no estimate of its own.

    Args:
        image: [H, W, 3] uint8.
        joints: [21, 3] of each hand, camera frame, metres.
        valid: of each hand.
        K: [3, 3].
    """
    picture = Image.fromarray(image)
    pen = ImageDraw.Draw(picture)
    width = max(1, round(image.shape[1] / 240))
    for side, points in joints.items():
        pixels = points @ K.T
        pixels = pixels[:, :2] / np.maximum(pixels[:, 2:], 1e-3)
        color = COLORS[side] if valid[side] else _MISSING
        for start, end in BONES:
            pen.line([tuple(pixels[start]), tuple(pixels[end])], fill=color, width=width)
    return np.asarray(picture)


def with_points(image: np.ndarray, points: np.ndarray, K: np.ndarray, valid: bool) -> np.ndarray:
    """The image with points [N, 3] (camera frame) as dots; grey where the frame has no own pose."""
    marked = image.copy()
    pixels = points @ K.T
    column, row = np.floor(pixels[:, :2] / np.maximum(pixels[:, 2:], 1e-3)).astype(int).T
    inside = (column >= 0) & (column < image.shape[1]) & (row >= 0) & (row < image.shape[0])
    marked[row[inside], column[inside]] = COLORS["object"] if valid else _MISSING
    return marked


def draw_clip(clip: Clip, hand_models: Mapping[Side, HandModel]) -> Callable[[int, np.ndarray], np.ndarray]:
    """Draws what a finished clip says of each frame: hands and object where the estimates put them."""
    sides = [side for side in SIDES if side in clip.hands]
    to_cam = clip.cam_from_world
    joints = {side: _moved(to_cam, joints_of_track(clip.hands[side], hand_models[side])) for side in sides}
    points = None
    if clip.object is not None:
        points = _moved(to_cam, clip.object.points_world())

    def draw(t: int, image: np.ndarray) -> np.ndarray:
        marked = image
        if points is not None and clip.object is not None:
            marked = with_points(marked, points[t], clip.K, bool(clip.object.valid[t]))
        valid = {side: bool(clip.hands[side].valid[t]) for side in sides}
        return with_skeletons(marked, {side: joints[side][t] for side in sides}, valid, clip.K)

    return draw


def _moved(to_cam: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points [T, N, 3] under rigid motions [T, 4, 4]."""
    return np.einsum("tij,tnj->tni", to_cam[:, :3, :3], points) + to_cam[:, None, :3, 3]

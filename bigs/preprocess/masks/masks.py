"""Masks that another tool made, in the common layouts, as label images of each frame.

- one folder of label images: HOLD's values (50 object, 150 right, 250 left), or any others that `labels`
  names, among them the palette images that SAM 2 and SAM-Track write (1, 2, 3 in the order of the clicks);
- one folder for each entity, called right, left and object (or as `labels` numbers them: 1, 001, ...), with
  images that are bright where it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from bigs.atomic import atomic_write
from bigs.checks import InputError, found_at
from bigs.data.images import open_picture
from bigs.preprocess.artefacts import MASKS, MASKS_FILE, FrameSet
from bigs.preprocess.frames.matching import match_names
from bigs.preprocess.frames.source import PICTURE_SUFFIXES, natural_order
from bigs.preprocess.stamps import write_json
from bigs.types import ENTITIES, MASK_VALUES, Entity

_FOLDER_NAMES: dict[Entity, tuple[str, ...]] = {
    "right": ("right", "right_hand", "hand_right"),
    "left": ("left", "left_hand", "hand_left"),
    "object": ("object", "obj"),
}
# A mask of one entity counts where it is brighter than this, since lossy files have no clean values.
_BRIGHT = 100
# Order in which overlapping masks are painted, the last on top: HOLD's order.
_PAINTED: tuple[Entity, ...] = ("right", "left", "object")


class MaskSource(NamedTuple):
    """Where the label images of the frames come from."""

    label: Callable[[int], tuple[np.ndarray, int]]  # frame -> [H, W] uint8 labels, and pixels claimed twice
    layout: str  # for people


def open_masks(folder: Path, frames: FrameSet, labels: Mapping[Entity, int] | None = None) -> MaskSource:
    """Recognise the layout of a folder of masks.

    Args:
        folder: label images, or one folder for each entity.
        frames: the frames they belong to.
        labels: which value (or numbered folder) means which entity; HOLD's values if not given.

    Raises:
        InputError: no such folder, no known layout, or a number of masks that fits no frames.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of masks, found {found_at(folder)}")
    entities = _entity_folders(folder, labels)
    if entities:
        return _folders_source(entities, frames)
    files = _pictures(folder)
    if not files:
        names = ", ".join(sorted(p.name for p in folder.iterdir())[:6]) or "nothing"
        raise InputError(
            f"{folder}: expected label images, or folders called right, left and object, found {names}"
        )
    chosen = _matched(folder, files, frames)
    values = labels or MASK_VALUES
    table = _table(values)

    def label(t: int) -> tuple[np.ndarray, int]:
        stored = _read_labels(chosen[t])
        found = np.flatnonzero(np.bincount(stored.ravel(), minlength=256))
        unknown = sorted(set(found.tolist()) - {0, *values.values()})
        if unknown:
            expected = ", ".join(f"{value} {entity}" for entity, value in values.items())
            others = ", ".join(map(str, unknown[:4]))
            raise InputError(
                f"{chosen[t]}: expected the mask values 0, {expected}, found {others} "
                "(--mask-labels says which value means what)"
            )
        return _resized(chosen[t], table[stored], frames), 0

    return MaskSource(label, f"{len(files)} label images")


def write_masks(
    processed: Path,
    frames: FrameSet,
    label: Callable[[int], tuple[np.ndarray, int]],
    inputs: str,
    check: Callable[[list[np.ndarray], list[int]], list[str]],
) -> list[np.ndarray]:
    """Write `masks/%04d.png`, then `masks.json` with what `check` finds in all of them.

    Args:
        processed: `CLIP/processed`.
        frames: the frames.
        label: gives the label image of a frame.
        inputs: the digest of what they are made from.
        check: from T label images and pixels claimed twice in each, what looks wrong, a sentence each.

    Returns:
        T label images [H, W] uint8.
    """
    folder = processed / MASKS
    folder.mkdir(parents=True, exist_ok=True)
    (processed / MASKS_FILE).unlink(missing_ok=True)
    masks, twice = [], []
    for t in range(len(frames.names)):
        mask, both = label(t)
        masks.append(mask)
        twice.append(both)
    notes = check(masks, twice)
    for t, mask in enumerate(masks):
        with atomic_write(folder / f"{t:04d}.png") as file:
            Image.fromarray(mask).save(file, "PNG")
    for stale in folder.glob("*.png"):
        if stale.stem.isdigit() and int(stale.stem) >= len(masks):
            stale.unlink()
    areas = {entity: [int((mask == MASK_VALUES[entity]).sum()) for mask in masks] for entity in ENTITIES}
    write_json(processed / MASKS_FILE, {"areas": areas, "notes": notes}, inputs)
    return masks


def _entity_folders(folder: Path, labels: Mapping[Entity, int] | None) -> dict[Entity, Path]:
    """The folder of each entity, where there are such folders."""
    found: dict[Entity, Path] = {}
    inside = {path.name.lower(): path for path in folder.iterdir() if path.is_dir()}
    for entity in ENTITIES:
        for name in _FOLDER_NAMES[entity]:
            if name in inside:
                found.setdefault(entity, inside[name])
        if labels and entity in labels:
            for name, path in inside.items():
                if name.isdigit() and int(name) == labels[entity]:
                    found.setdefault(entity, path)
    return found


def _folders_source(folders: Mapping[Entity, Path], frames: FrameSet) -> MaskSource:
    chosen: dict[Entity, list[Path | None]] = {}
    for entity, folder in folders.items():
        files = _pictures(folder)
        if not files:
            raise InputError(f"{folder}: expected mask images, found none in this folder")
        places = match_names(str(folder), [file.name for file in files], frames)
        chosen[entity] = [None if place is None else files[place] for place in places]

    def label(t: int) -> tuple[np.ndarray, int]:
        mask = np.zeros((frames.height, frames.width), dtype=np.uint8)
        claims = np.zeros(mask.shape, dtype=np.uint8)
        for entity in _PAINTED:
            path = chosen[entity][t] if entity in chosen else None
            if path is None:
                continue
            bright = _read_bright(path)
            inside = _resized(path, (bright * np.uint8(255)).astype(np.uint8), frames) > 0
            mask[inside] = MASK_VALUES[entity]
            claims += inside
        return mask, int((claims > 1).sum())

    return MaskSource(label, f"folders {', '.join(path.name for path in folders.values())}")


def _pictures(folder: Path) -> list[Path]:
    return sorted((p for p in folder.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES), key=natural_order)


def _matched(folder: Path, files: list[Path], frames: FrameSet) -> list[Path]:
    places = match_names(str(folder), [file.name for file in files], frames)
    chosen: list[Path] = []
    for name, place in zip(frames.names, places, strict=True):
        if place is None:
            raise InputError(f"{folder}: expected a mask for each frame, found none for {name}")
        chosen.append(files[place])
    return chosen


def _table(values: Mapping[Entity, int]) -> np.ndarray:
    """From a stored value to the value of our own, [256]."""
    table = np.zeros(256, dtype=np.uint8)
    for entity, value in values.items():
        if not 0 < value < 256:
            raise InputError(f"--mask-labels: expected values from 1 to 255, found {entity}={value}")
        table[value] = MASK_VALUES[entity]
    return table


def _read_labels(path: Path) -> np.ndarray:
    """Stored values [H, W] uint8: the index of a palette image, the grey value of another."""
    with open_picture(path) as image:
        if image.mode not in ("L", "P", "1"):
            pixels = np.asarray(image.convert("RGB"))
            if (pixels != pixels[..., :1]).any():
                raise InputError(
                    f"{path}: expected a palette or grey label image, found colours (mode {image.mode}); "
                    "save the labels themselves, not a coloured picture of them"
                )
            return pixels[..., 0]
        return np.asarray(image).astype(np.uint8)


def _read_bright(path: Path) -> np.ndarray:
    """Where an image of one entity shows it, [H, W] bool."""
    with open_picture(path) as image:
        if image.mode == "P":
            return np.asarray(image) > 0
        grey = np.asarray(image.convert("L"))
    # Some tools write 0 and 1.
    return grey > (0 if grey.max() <= 1 else _BRIGHT)


def _resized(path: Path, mask: np.ndarray, frames: FrameSet) -> np.ndarray:
    """The mask at the frames' size; only the same picture at another size is accepted."""
    height, width = mask.shape
    if (width, height) == (frames.width, frames.height):
        return mask
    if abs(width * frames.height / (height * frames.width) - 1) > 0.02:
        raise InputError(
            f"{path}: expected the proportions of {frames.width} x {frames.height}, found {width} x {height}"
        )
    size = (frames.width, frames.height)
    return np.asarray(Image.fromarray(mask).resize(size, Image.Resampling.NEAREST))

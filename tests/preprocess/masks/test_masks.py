"""Masks in every common layout, and what is said when they look wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_artefacts import FRAME_SET

from bigs.checks import InputError
from bigs.preprocess.artefacts import FrameSet, mask_paths
from bigs.preprocess.masks.checks import check_masks
from bigs.preprocess.masks.masks import open_masks, write_masks
from bigs.types import MASK_VALUES, Entity

T = 5
FRAMES: FrameSet = replace(FRAME_SET, names=tuple(f"{t:05d}.jpg" for t in range(T)))
BOXES: dict[Entity, tuple[slice, slice]] = {
    "right": (slice(4, 20), slice(2, 20)),
    "left": (slice(4, 20), slice(40, 60)),
    "object": (slice(10, 40), slice(16, 44)),
}
LABELS: dict[Entity, int] = {"right": 1, "left": 2, "object": 3}


def labelled(values: dict[Entity, int], t: int = 0) -> np.ndarray:
    """Right, then left, then object on top, a little lower in each frame."""
    mask = np.zeros((FRAMES.height, FRAMES.width), np.uint8)
    for entity, box in BOXES.items():
        mask[box] = values[entity]
    return np.roll(mask, t, axis=0)


def expected(t: int) -> np.ndarray:
    return labelled(MASK_VALUES, t)


def test_label_images_of_hold(tmp_path: Path) -> None:
    for t in range(T):
        Image.fromarray(expected(t)).save(tmp_path / f"{t:05d}.png")
    source = open_masks(tmp_path, FRAMES)
    assert all(np.array_equal(source.label(t)[0], expected(t)) for t in range(T))


def test_palette_images_of_sam_track(tmp_path: Path) -> None:
    for t in range(T):
        image = Image.fromarray(labelled(LABELS, t), mode=None).convert("P")
        image.putdata(labelled(LABELS, t).ravel())
        image.putpalette([0, 0, 0, 200, 0, 0, 0, 200, 0, 0, 0, 200] + [7] * 744)
        image.save(tmp_path / f"{t:05d}.png")
    source = open_masks(tmp_path, FRAMES, LABELS)
    assert all(np.array_equal(source.label(t)[0], expected(t)) for t in range(T))
    with pytest.raises(
        InputError, match="expected the mask values 0, 50 object, 150 right, 250 left, found 1, 2, 3"
    ):
        open_masks(tmp_path, FRAMES).label(0)


@pytest.mark.parametrize("names", [("right", "left", "object"), ("001", "2", "3")])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_folder_for_each_entity(tmp_path: Path, names: tuple[str, ...], suffix: str) -> None:
    for entity, name in zip(("right", "left", "object"), names, strict=True):
        (tmp_path / name).mkdir()
        for t in range(T):
            mask = np.zeros((FRAMES.height, FRAMES.width), np.uint8)
            mask[BOXES[entity]] = 255  # type: ignore[index]
            Image.fromarray(np.roll(mask, t, axis=0)).save(tmp_path / name / f"{t:05d}{suffix}", quality=95)
    source = open_masks(tmp_path, FRAMES, LABELS if names[0] == "001" else None)
    for t in range(T):
        mask, twice = source.label(t)
        # The object wins where folders overlap: 16 columns of it lie over the hands.
        assert (mask != expected(t)).mean() < (0.02 if suffix == ".jpg" else 1e-9)
        assert abs(twice - 80) <= 8


def test_one_hand_and_missing_files_are_empty(tmp_path: Path) -> None:
    for entity in ("right", "object"):
        (tmp_path / entity).mkdir()
        for t in range(T):
            if (entity, t) != ("right", 3):
                Image.fromarray(np.full((48, 64), 1, np.uint8)).save(tmp_path / entity / f"{t:05d}.png")
    mask, _ = open_masks(tmp_path, FRAMES).label(3)
    assert (mask == MASK_VALUES["object"]).all()


def test_masks_of_another_size_are_brought_to_the_frames(tmp_path: Path) -> None:
    for t in range(T):
        Image.fromarray(expected(t)).resize((128, 96), Image.Resampling.NEAREST).save(tmp_path / f"{t}.png")
    assert np.array_equal(open_masks(tmp_path, FRAMES).label(2)[0], expected(2))
    Image.fromarray(np.zeros((96, 96), np.uint8)).save(tmp_path / "0.png")
    with pytest.raises(InputError, match="expected the proportions of 64 x 48, found 96 x 96"):
        open_masks(tmp_path, FRAMES).label(0)


def test_masks_of_the_whole_video_are_thinned(tmp_path: Path) -> None:
    for t in range(2 * T):
        Image.fromarray(expected(t)).save(tmp_path / f"m{t:03d}.png")
    thinned = replace(FRAMES, source_frames=tuple(range(0, 2 * T, 2)), source_length=2 * T)
    assert np.array_equal(open_masks(tmp_path, thinned).label(3)[0], expected(6))


def test_unusable_folders_are_told_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a folder of masks, found nothing"):
        open_masks(tmp_path / "none", FRAMES)
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(InputError, match=r"folders called right, left and object, found notes.txt"):
        open_masks(tmp_path, FRAMES)
    for t in range(T - 1):
        Image.fromarray(expected(t)).save(tmp_path / f"x{t}.png")
    with pytest.raises(InputError, match="expected 5"):
        open_masks(tmp_path, FRAMES)
    colours = np.zeros((48, 64, 3), np.uint8)
    colours[:10] = (200, 0, 0)
    Image.fromarray(colours).save(tmp_path / "x4.png")
    with pytest.raises(InputError, match="found colours"):
        open_masks(tmp_path, FRAMES).label(4)
    (tmp_path / "x4.png").write_bytes(b"\x89PNG damaged")
    with pytest.raises(InputError, match="expected a readable image"):
        open_masks(tmp_path, FRAMES).label(4)


def test_what_is_written_is_small_and_read_back(tmp_path: Path) -> None:
    masks = write_masks(
        tmp_path,
        FRAMES,
        lambda t: (expected(t), 0),
        "x",
        lambda m, twice: check_masks(m, twice, FRAMES.names),
    )
    files = mask_paths(tmp_path, FRAMES)
    assert len(masks) == len(files) == T
    assert np.array_equal(np.asarray(Image.open(files[4])), expected(4))


def clip_masks(frames: int = 12) -> list[np.ndarray]:
    return [labelled(MASK_VALUES, t % 4) for t in range(frames)]


def notes(masks: list[np.ndarray], twice: dict[int, int] | None = None) -> list[str]:
    claimed = [(twice or {}).get(t, 0) for t in range(len(masks))]
    return check_masks(masks, claimed, [str(t) for t in range(len(masks))])


def test_good_masks_have_no_notes() -> None:
    assert notes(clip_masks()) == []


def test_each_fault_is_named_with_its_frames() -> None:
    masks = clip_masks()
    masks[3][masks[3] == MASK_VALUES["left"]] = 0
    assert notes(masks) == ["left: empty in frame 3"]
    masks = clip_masks()
    masks[5][20:46, 2:62] = MASK_VALUES["object"]
    assert notes(masks) == ["object: area jumps in frame 5"]
    masks = clip_masks()
    for column in range(0, 60, 6):
        masks[7][43:47, column : column + 3] = MASK_VALUES["right"]
    assert any(note.startswith("right: in more than 6 pieces in frame 7") for note in notes(masks))
    assert "overlaps: up to 22 %" in notes(clip_masks(), {2: 300, 3: 300})[0]
    one = [np.where(mask == MASK_VALUES["left"], 0, mask).astype(np.uint8) for mask in clip_masks()]
    assert notes(one) == ["left: in no mask"]


def test_a_hand_that_comes_in_is_no_flicker() -> None:
    masks = clip_masks()
    for mask in masks[:6]:
        mask[mask == MASK_VALUES["left"]] = 0
    assert notes(masks) == ["left: empty in frames 0-5"]


def test_nothing_to_reconstruct_is_refused() -> None:
    bare = [np.where(mask == MASK_VALUES["object"], 0, mask).astype(np.uint8) for mask in clip_masks()]
    with pytest.raises(
        InputError, match="expected an object in the video, found no object pixel in any of 12"
    ):
        notes(bare)
    alone = [np.where(mask == MASK_VALUES["object"], mask, 0).astype(np.uint8) for mask in clip_masks()]
    with pytest.raises(InputError, match="expected a hand in the video"):
        notes(alone)

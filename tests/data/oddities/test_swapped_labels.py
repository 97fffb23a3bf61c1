"""Exchanged labels of hands are found and changed back; right ones stay."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bigs.commands.clips.open import open_clip
from bigs.data.base import Clip
from bigs.data.excerpt import excerpt
from bigs.data.oddities.swapped_labels import with_labels_sorted
from bigs.hand import HandModel
from bigs.types import MASK_VALUES, Side


def exchanged(tiny_clip: Path, folder: Path, frames: list[int], blank: list[int]) -> Path:
    """A copy whose masks have the hands exchanged in some frames, and nothing in others."""
    copy = folder / "clip"
    shutil.copytree(tiny_clip, copy)
    files = sorted((copy / "build" if (copy / "build").is_dir() else copy).glob("**/mask/*.png"))
    for t in (*frames, *blank):
        labels = np.array(Image.open(files[t]))
        right, left = (labels == MASK_VALUES[side] for side in ("right", "left"))
        labels[right], labels[left] = MASK_VALUES["left"], MASK_VALUES["right"]
        Image.fromarray(np.zeros_like(labels) if t in blank else labels).save(files[t])
    return copy


@pytest.fixture
def clean(tiny_clip: Path, both_hands: Mapping[Side, HandModel]) -> Clip:
    return open_clip(tiny_clip, both_hands)


def test_right_labels_stay(clean: Clip) -> None:
    assert clean.swapped is None and clean.notes == ()


@pytest.mark.parametrize(
    ("frames", "blank"), [([4], []), ([0], []), ([11], [10]), ([2, 7, 8, 9], [3]), ([1, 2, 3, 4, 5], [])]
)
def test_exchanged_labels_are_changed_back(
    clean: Clip,
    tiny_clip: Path,
    both_hands: Mapping[Side, HandModel],
    tmp_path: Path,
    frames: list[int],
    blank: list[int],
) -> None:
    clip = open_clip(exchanged(tiny_clip, tmp_path, frames, blank), both_hands)
    assert clip.swapped is not None and np.flatnonzero(clip.swapped).tolist() == frames
    numbers = f"{len(frames)} frames ({', '.join(map(str, frames))})" if frames[1:] else f"frame {frames[0]}"
    assert clip.notes == (f"masks: right and left hand exchanged in {numbers}; changed back",)
    for t in range(len(clip)):
        if t not in blank:
            np.testing.assert_array_equal(clip.mask(t), clean.mask(t))
            assert clip.mask_areas["right"][t] == clean.mask_areas["right"][t]
    part = excerpt(clip, [frames[0], 6])
    np.testing.assert_array_equal(part.mask(0), clean.mask(frames[0]))


def test_one_hand_has_nothing_to_be_exchanged_with(
    tiny_clip: Path, both_hands: Mapping[Side, HandModel], tmp_path: Path
) -> None:
    clip = open_clip(tiny_clip, both_hands)
    assert with_labels_sorted(clip, {"right": np.zeros((len(clip), 21, 3))}) is clip

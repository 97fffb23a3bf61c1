"""Pictures that repeat the one before are noted where they come at a steady pace, and nothing else is."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from toy_clips import painted_clip

from bigs.commands.clips.open import open_clip
from bigs.data.oddities import repeats
from bigs.data.oddities.repeats import every_new, with_repeats_noted
from bigs.hand import HandModel
from bigs.types import Side

FRAMES = 40


def film(noise: float, *, still: int = 0) -> np.ndarray:
    """A printed square that wanders over a wall [T, 48, 100, 3] once it has rested for `still` frames."""
    rng = np.random.default_rng(0)
    pictures = np.tile(rng.uniform(60, 120, (48, 100, 3)), (FRAMES, 1, 1, 1))
    print_ = rng.uniform(100, 250, (32, 20, 3))
    for t in range(FRAMES):
        x = 2 * max(t - still, 0)
        pictures[t, 8:40, x : x + 20] = print_
    return np.clip(pictures + noise * rng.standard_normal(pictures.shape), 0, 255).astype(np.uint8)


def compressed(pictures: np.ndarray) -> np.ndarray:
    """As a second compression leaves them: off by a level here and there."""
    change = np.random.default_rng(1).random(pictures.shape) < 0.1
    return np.clip(pictures.astype(int) + change, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("noise", [0.0, 3.0])
@pytest.mark.parametrize("every", [2, 3, 4])
@pytest.mark.parametrize("begin", [0, 1])
def test_steady_repeats_are_counted(noise: float, every: int, begin: int) -> None:
    pictures = compressed(film(noise)[(np.arange(FRAMES) + begin) // every])
    assert every_new(lambda t: pictures[t], FRAMES) == every


def test_a_group_may_be_longer_or_shorter() -> None:
    shown = np.concatenate([np.arange(20) // 2, [9], 10 + np.arange(19) // 2])
    pictures = film(2.0)[shown]
    assert every_new(lambda t: pictures[t], len(shown)) == 2


@pytest.mark.parametrize(
    "shown",
    [
        np.arange(FRAMES),
        (np.arange(FRAMES) * 0.8).astype(int),  # 24 pictures a second as 30
        (np.arange(FRAMES) * 0.4).astype(int),  # 12 as 30: two and three in turn
        np.arange(FRAMES) // 5,
        np.zeros(FRAMES, dtype=int),
        np.sort(np.random.default_rng(0).integers(0, 20, FRAMES)),
        np.arange(12) // 2,
    ],
    ids=["all new", "a few", "in turn", "too slow", "one picture", "by chance", "too short to tell"],
)
def test_others_are_not(shown: np.ndarray) -> None:
    pictures = film(2.0)[shown]
    assert every_new(lambda t: pictures[t], len(shown)) == 1


def test_what_rests_is_no_repeat() -> None:
    pictures = film(0.0, still=25)
    assert every_new(lambda t: pictures[t], FRAMES) == 1


def test_most_clips_are_not_read_whole() -> None:
    pictures, read = film(2.0), []
    every_new(lambda t: pictures[read.append(t) or t], FRAMES)  # type: ignore[func-returns-value]
    assert len(read) < FRAMES / 2


@pytest.mark.parametrize("every", [1, 2])
def test_a_note_says_what_to_do(tmp_path: Path, every: int) -> None:
    pictures = film(2.0)[np.arange(FRAMES) // every]
    clip = painted_clip(tmp_path, pictures, np.full(pictures.shape[:3], 150, dtype=np.uint8))
    notes = with_repeats_noted(clip).notes
    assert len(notes) == len(clip.notes) + every - 1
    assert all(f"bigs convert --every {every}" in note for note in notes)


def test_clips_are_opened_with_the_note(
    tiny_clip: Path, both_hands: Mapping[Side, HandModel], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(repeats, "_FIRST", 6)  # the little clip has twelve frames
    assert not open_clip(tiny_clip, both_hands).notes
    clip = Path(shutil.copytree(tiny_clip, tmp_path / "clip"))
    images = sorted((clip / "build" / "image").iterdir())
    for before, after in zip(images[::2], images[1::2], strict=True):
        shutil.copyfile(before, after)
    assert any(note.startswith("pictures: of 2 in a row") for note in open_clip(clip, both_hands).notes)

"""How fast a clip moves: frames that are left out without a word of it are noticed, and nothing else is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from toy_clips import painted_clip

from bigs.commands.clips.open import open_clip
from bigs.data.base import Clip
from bigs.data.oddities import pace
from bigs.data.oddities.pace import with_pace
from bigs.hand import HandModel
from bigs.types import MASK_VALUES, Entity, Side

HEIGHT, WIDTH = 120, 160
# Metres from the camera, and pixels of focal length: a pixel is 2.5 mm.
DISTANCE, FOCAL = 0.5, 200.0
# Pixels and frames of one swing at 30 a second, whose acceleration is 1.1 mm a frame at most.
SWING, PERIOD = 25.0, 45.0


def filmed(
    folder: Path, *, every: int = 1, frames: int = 30, wobble: float = 0.0, resting: Entity | None = None
) -> Clip:
    """Two hands and an object that swing to and fro, of which every so manyth frame is kept.

    Args:
        folder: for its files.
        every: which frames are kept.
        frames: how many are kept.
        wobble: pixels by which masks are off, by chance.
        resting: what does not move.
    """
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    masks = np.zeros((frames, HEIGHT, WIDTH), dtype=np.uint8)
    for number, (entity, value) in enumerate(MASK_VALUES.items()):
        for t in range(frames):
            swing = 0.0 if entity == resting else np.sin(2 * np.pi * every * t / PERIOD + number)
            middle = np.array([20.0 + 40 * number, 80.0 + SWING * swing]) + wobble * rng.standard_normal(2)
            masks[t][(rows - middle[0]) ** 2 + (columns - middle[1]) ** 2 < 14**2] = value
    images = np.full((frames, HEIGHT, WIDTH, 3), 128, dtype=np.uint8)
    K = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    clip = painted_clip(folder, images, masks, K)
    ahead = np.tile([0.0, 0.0, DISTANCE], (frames, 1))
    assert clip.object is not None
    return replace(
        clip,
        hands={side: replace(track, transl=ahead) for side, track in clip.hands.items()},
        object=replace(clip.object, transl=ahead),
    )


@pytest.mark.parametrize("wobble", [0.0, 1.0])
def test_a_clip_that_moves_as_usual_keeps_its_rate(tmp_path: Path, wobble: float) -> None:
    clip = filmed(tmp_path, wobble=wobble)
    assert with_pace(clip) is clip


@pytest.mark.parametrize("every", [2, 3, 5])
def test_frames_that_are_left_out_are_noticed(tmp_path: Path, every: int) -> None:
    clip = with_pace(filmed(tmp_path, every=every))
    assert clip.pace is not None and clip.pace == pytest.approx(30 / every, rel=0.35)
    assert clip.fps == 30.0
    assert [note for note in clip.notes if note.startswith("frames a second: 30, yet")]


def test_a_rate_that_is_said_is_no_surprise(tmp_path: Path) -> None:
    clip = replace(filmed(tmp_path, every=3), fps=10.0)
    assert with_pace(clip) is clip


def test_a_rate_is_judged_for_what_it_is(tmp_path: Path) -> None:
    clip = with_pace(replace(filmed(tmp_path), fps=90.0))
    assert clip.pace == pytest.approx(30.0, rel=0.35)


@pytest.mark.parametrize("resting", MASK_VALUES)
def test_what_rests_leaves_the_rate_as_it_is(tmp_path: Path, resting: Entity) -> None:
    clip = filmed(tmp_path, every=3, resting=resting)
    assert with_pace(clip) is clip


def test_distances_count(tmp_path: Path) -> None:
    clip = filmed(tmp_path, every=3)
    assert clip.object is not None
    near = replace(
        clip,
        hands={side: replace(track, transl=0.1 * track.transl) for side, track in clip.hands.items()},
        object=replace(clip.object, transl=0.1 * clip.object.transl),
    )
    assert with_pace(near) is near


def test_few_frames_tell_nothing(tmp_path: Path) -> None:
    clip = filmed(tmp_path, every=3, frames=14)
    assert with_pace(clip) is clip


def test_frames_without_masks_are_left_out(tmp_path: Path) -> None:
    clip = filmed(tmp_path, every=3, frames=40)
    for t in (5, 21):
        Image.fromarray(np.zeros((HEIGHT, WIDTH), dtype=np.uint8)).save(clip.mask_paths[t])
    assert with_pace(clip).pace == pytest.approx(10.0, rel=0.35)


def test_clips_are_opened_with_their_pace(
    tiny_clip: Path, both_hands: Mapping[Side, HandModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The little clip turns its object within twelve frames, which are too few otherwise."""
    assert open_clip(tiny_clip, both_hands).pace is None
    monkeypatch.setattr(pace, "_LEAST", 6)
    clip = open_clip(tiny_clip, both_hands)
    assert clip.pace is not None and clip.pace < 20.0 and "frames a second: 30" in clip.notes[-1]


def test_no_masks_no_pace(tmp_path: Path) -> None:
    clip = replace(filmed(tmp_path, every=3), mask_paths=())
    assert with_pace(clip) is clip

"""Decoded frames are kept: read once, never shared, no more than there is room for."""

from __future__ import annotations

import os
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from toy_clips import painted_clip

from bigs.checks import InputError
from bigs.data import load_clip
from bigs.data.decoded import DecodedFrames

SIZE = (7, 5)


def frames(folder: Path, count: int) -> list[Path]:
    paths = [folder / f"{t:04d}.png" for t in range(count)]
    for t, path in enumerate(paths):
        Image.fromarray(np.full((SIZE[1], SIZE[0], 3), 10 + t, dtype=np.uint8)).save(path)
    return paths


def test_a_clip_decodes_each_file_once(tmp_path: Path, reads: Counter[str]) -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (3, 6, 8, 3), dtype=np.uint8)
    masks = rng.choice(np.array([0, 50, 150, 250], dtype=np.uint8), (3, 6, 8))
    clip = painted_clip(tmp_path, images, masks)
    for _ in range(3):
        for t in range(3):
            assert (clip.image(t) == images[t]).all() and (clip.mask(t) == masks[t]).all()
    assert set(reads.values()) == {1} and len(reads) == 6


def test_loading_a_clip_is_its_first_reading(tiny_clip: Path, reads: Counter[str]) -> None:
    clip = load_clip(tiny_clip, np.zeros((15, 3)))
    for other in (clip, replace(clip, K=2.0 * clip.K)):
        for t in range(len(clip)):
            other.image(t)
            other.mask(t)
    assert set(reads.values()) == {1} and len(reads) == 2 * len(clip)


def test_checking_frames_is_their_first_reading(tmp_path: Path, reads: Counter[str]) -> None:
    paths = frames(tmp_path, 2)
    decoded = DecodedFrames()
    decoded.read_all(paths, (), SIZE)
    decoded.image(paths[1], SIZE)
    assert set(reads.values()) == {1}


def test_what_a_caller_does_to_its_array_nobody_else_sees(tmp_path: Path) -> None:
    (path,) = frames(tmp_path, 1)
    decoded = DecodedFrames()
    for _ in range(3):
        pixels = decoded.image(path, SIZE)
        assert (pixels == 10).all()
        pixels[:] = 0


def test_what_does_not_fit_is_read_again(tmp_path: Path, reads: Counter[str]) -> None:
    paths = frames(tmp_path, 3)
    bytes_of_one = 3 * SIZE[0] * SIZE[1]
    decoded = DecodedFrames(2 * bytes_of_one + bytes_of_one // 2)
    for _ in range(2):
        assert [int(decoded.image(path, SIZE)[0, 0, 0]) for path in paths] == [10, 11, 12]
    assert sorted(reads.values()) == [1, 1, 2]


def test_a_file_that_changed_is_read_anew(tmp_path: Path) -> None:
    (path,) = frames(tmp_path, 1)
    decoded = DecodedFrames()
    decoded.image(path, SIZE)
    Image.fromarray(np.full((SIZE[1], SIZE[0], 3), 99, dtype=np.uint8)).save(path)
    os.utime(path, ns=(1, 1))
    assert (decoded.image(path, SIZE) == 99).all()


def test_a_file_that_went_away_is_missed(tmp_path: Path) -> None:
    (path,) = frames(tmp_path, 1)
    decoded = DecodedFrames()
    decoded.image(path, SIZE)
    path.unlink()
    with pytest.raises(InputError, match=r"0000\.png: expected an image"):
        decoded.image(path, SIZE)


def test_threads_keep_each_file_once(tmp_path: Path) -> None:
    paths = frames(tmp_path, 4)
    bytes_of_one = 3 * SIZE[0] * SIZE[1]
    decoded = DecodedFrames(4 * bytes_of_one)
    with ThreadPoolExecutor(8) as pool:
        for pixels, t in pool.map(lambda t: (decoded.image(paths[t], SIZE), t), [0, 1, 2, 3] * 25):
            assert (pixels == 10 + t).all()
    assert decoded._room == 0


def test_a_size_is_asked_for_each_time(tmp_path: Path) -> None:
    (path,) = frames(tmp_path, 1)
    decoded = DecodedFrames()
    decoded.image(path, SIZE)
    with pytest.raises(InputError, match="expected 5 x 7 pixels as in the first frame, found 7 x 5"):
        decoded.image(path, (5, 7))

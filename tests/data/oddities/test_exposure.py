"""Exposure that wavers: what a still background tells is taken out, and nothing is made up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.ndimage
from toy_clips import painted_clip

from bigs.data.base import Clip
from bigs.data.excerpt import excerpt
from bigs.data.oddities.exposure import with_one_exposure

FRAMES, HEIGHT, WIDTH = 12, 90, 120


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def room(rng: np.random.Generator, width: int = WIDTH, coarse: float = 3.0) -> np.ndarray:
    """A background [H, W, 3] in [0, 1] with structure of some pixels."""
    blocks = scipy.ndimage.gaussian_filter(rng.normal(size=(HEIGHT, width, 3)), (coarse, coarse, 0))
    return 0.45 + 0.12 * blocks / blocks.std()


def moving_hand() -> np.ndarray:
    """[T, H, W] bool: a quarter of the image that moves right."""
    hand = np.zeros((FRAMES, HEIGHT, WIDTH), dtype=bool)
    for t in range(FRAMES):
        hand[t, 20:65, 4 * t : 4 * t + 60] = True
    return hand


def to_bytes(images: np.ndarray, rng: np.random.Generator, noise: float = 0.03) -> np.ndarray:
    noisy = images + rng.normal(0, noise, images.shape)
    return (255 * noisy.clip(0, 1)).round().astype(np.uint8)


def filmed(
    folder: Path, rng: np.random.Generator, gains: np.ndarray, noise: float = 0.03
) -> tuple[Clip, np.ndarray]:
    """A clip of a hand in a room whose channels are multiplied by gains [T, 3], and images [T, H, W, 3] of
    one exposure without noise."""
    hand = moving_hand()
    images = np.broadcast_to(room(rng), (FRAMES, HEIGHT, WIDTH, 3)).copy()
    images[hand] = [0.5, 0.35, 0.3]
    clip = painted_clip(
        folder,
        to_bytes(gains[:, None, None] * images, rng, noise),
        np.where(hand, np.uint8(150), np.uint8(0)),
    )
    return clip, images


def wavering() -> np.ndarray:
    """Gains [T, 3] whose median over time is 1: brighter and darker, and warmer at the end."""
    gains = np.ones((FRAMES, 3))
    gains[[1, 2, 3]] = [[0.8], [1.25], [0.9]]
    gains[9:] = [1.1, 1.0, 0.85]
    return gains


def test_gains_are_found_and_taken_out(tmp_path: Path, rng: np.random.Generator) -> None:
    gains = wavering()
    clip, images = filmed(tmp_path, rng, gains)
    steady = with_one_exposure(clip)
    assert steady.gains is not None
    assert np.abs(steady.gains - gains).max() < 0.01
    for t in range(FRAMES):
        assert np.abs(steady.image(t) / 255.0 - images[t]).mean((0, 1)).max() < 0.04  # the noise
        assert np.abs((steady.image(t) / 255.0 - images[t]).mean((0, 1))).max() < 0.005
    assert steady.notes == (
        "exposure: frames are 0.80 to 1.25 times as bright as usual; brought to one exposure",
    )


def test_what_is_cut_off_or_dark_tells_nothing(tmp_path: Path, rng: np.random.Generator) -> None:
    """Brighter frames cut a window off, and noise fills a dark corner."""
    gains = np.ones((FRAMES, 3))
    gains[3:6] = 1.25
    images = np.broadcast_to(room(rng), (FRAMES, HEIGHT, WIDTH, 3)).copy()
    images[:, :, :60] = 0.9
    images[:, :, 60:100] = 0.01
    pictures = to_bytes(gains[:, None, None] * images, rng)
    clip = with_one_exposure(painted_clip(tmp_path, pictures, np.zeros(pictures.shape[:3], np.uint8)))
    assert clip.gains is not None
    assert np.abs(clip.gains - gains).max() < 0.015


def test_a_sleeve_without_a_label_changes_nothing(tmp_path: Path, rng: np.random.Generator) -> None:
    gains = wavering()
    images = np.broadcast_to(room(rng), (FRAMES, HEIGHT, WIDTH, 3)).copy()
    for t in range(FRAMES):
        images[t, 30:, 7 * t : 7 * t + 30] = [0.15, 0.2, 0.9]
    pictures = to_bytes(gains[:, None, None] * images, rng)
    clip = with_one_exposure(painted_clip(tmp_path, pictures, np.zeros(pictures.shape[:3], np.uint8)))
    assert clip.gains is not None
    assert np.abs(clip.gains - gains).max() < 0.02


@pytest.mark.parametrize(("waver", "noise"), [(0.0, 0.0), (0.0, 0.05), (0.01, 0.0)])
def test_a_steady_clip_stays_as_it_is(
    tmp_path: Path, rng: np.random.Generator, waver: float, noise: float
) -> None:
    gains = 1.0 + rng.uniform(-waver, waver, (FRAMES, 1)).repeat(3, axis=1)
    clip, _ = filmed(tmp_path, rng, gains, noise)
    assert with_one_exposure(clip) is clip


@pytest.mark.parametrize("coarse", [3, 20])
def test_a_moving_camera_is_no_exposure(tmp_path: Path, rng: np.random.Generator, coarse: float) -> None:
    """New parts of a room come into view, brighter or darker ones where its structure is coarse."""
    wide = room(rng, WIDTH + 12 * FRAMES, coarse)
    images = np.stack([wide[:, 12 * t : 12 * t + WIDTH] for t in range(FRAMES)])
    labels = np.where(moving_hand(), np.uint8(150), np.uint8(0))
    clip = painted_clip(tmp_path, to_bytes(images, rng), labels)
    assert with_one_exposure(clip) is clip


def test_subjects_that_fill_the_image_hide_what_tells(tmp_path: Path, rng: np.random.Generator) -> None:
    clip, _ = filmed(tmp_path / "room", rng, wavering())
    filled = painted_clip(
        tmp_path / "filled",
        np.stack([clip.image(t) for t in range(FRAMES)]),
        np.full((FRAMES, HEIGHT, WIDTH), 50, np.uint8),
    )
    assert with_one_exposure(filled) is filled
    assert with_one_exposure(replace(clip, mask_paths=())).gains is None


def test_chosen_frames_keep_their_gains(tmp_path: Path, rng: np.random.Generator) -> None:
    clip, images = filmed(tmp_path, rng, wavering())
    fewer = excerpt(with_one_exposure(clip), np.array([2, 1]))
    assert np.abs(fewer.image(0) / 255.0 - images[2]).mean() < 0.04
    assert np.abs(fewer.image(1) / 255.0 - images[1]).mean() < 0.04

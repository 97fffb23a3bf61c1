"""Unlabelled occluders: a sleeve before a still background is found, and nothing is made up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.ndimage
from toy_clips import painted_clip

from bigs.data.oddities.exposure import with_one_exposure
from bigs.train.start.background import unknown_occluders

FRAMES, HEIGHT, WIDTH = 9, 60, 80


def room(rng: np.random.Generator, width: int = WIDTH) -> np.ndarray:
    """A background with structure, [H, W, 3] in [0, 1]."""
    blocks = scipy.ndimage.gaussian_filter(rng.normal(size=(HEIGHT, width, 3)), (2, 2, 0))
    return 0.5 + 0.15 * blocks / blocks.std()


def to_bytes(images: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """With a sensor's noise."""
    noisy = images + rng.normal(0, 1.5 / 255, images.shape)
    return (255 * noisy.clip(0, 1)).round().astype(np.uint8)


def moving_box(top: int, left: int, height: int, width: int, step: int) -> np.ndarray:
    """[T, H, W] bool: a box that moves right."""
    box = np.zeros((FRAMES, HEIGHT, WIDTH), dtype=bool)
    for t in range(FRAMES):
        box[t, top : top + height, left + step * t : left + step * t + width] = True
    return box


def wrist_at(columns: np.ndarray, rows: float, away: tuple[float, float]) -> np.ndarray:
    """Joints [T, 21, 3], half a metre from a painted clip's camera, of a hand whose arm goes that way."""
    joints = np.full((FRAMES, 21, 3), 0.5)
    joints[..., 0] = (columns[:, None] - WIDTH / 2) / 100.0 * 0.5
    joints[..., 1] = (rows - HEIGHT / 2) / 100.0 * 0.5
    joints[:, 4, :2] -= 0.08 * np.array(away)
    return joints


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_finds_a_moving_sleeve(tmp_path: Path, rng: np.random.Generator) -> None:
    hand, sleeve = moving_box(25, 5, 12, 12, 5), moving_box(37, 5, 14, 12, 5)
    images = np.broadcast_to(room(rng), (FRAMES, HEIGHT, WIDTH, 3)).copy()
    images[hand] = [0.8, 0.6, 0.5]
    images[sleeve] = [0.1, 0.15, 0.9]
    clip = painted_clip(tmp_path, to_bytes(images, rng), np.where(hand, np.uint8(150), np.uint8(0)))
    found = unknown_occluders(clip, {"right": wrist_at(11 + 5 * np.arange(FRAMES), 37, (0.0, 1.0))}).pixels
    assert found.shape == (FRAMES, HEIGHT, WIDTH) and found.dtype == bool
    assert found[sleeve].mean() > 0.95
    assert not found[hand].any()
    near = scipy.ndimage.binary_dilation(sleeve, np.ones((1, 7, 7)))
    assert found[~near].mean() < 0.005


def test_exposure_that_wavers_hides_no_background(tmp_path: Path, rng: np.random.Generator) -> None:
    hand, sleeve = moving_box(25, 5, 12, 12, 5), moving_box(37, 5, 14, 12, 5)
    images = np.broadcast_to(room(rng), (FRAMES, HEIGHT, WIDTH, 3)).copy()
    images[hand] = [0.8, 0.6, 0.5]
    images[sleeve] = [0.1, 0.15, 0.9]
    gains = rng.uniform(0.8, 1.2, FRAMES)[:, None, None, None]
    clip = painted_clip(tmp_path, to_bytes(gains * images, rng), np.where(hand, np.uint8(150), np.uint8(0)))
    found = unknown_occluders(
        with_one_exposure(clip), {"right": wrist_at(11 + 5 * np.arange(FRAMES), 37, (0.0, 1.0))}
    ).pixels
    assert found[sleeve].mean() > 0.95
    near = scipy.ndimage.binary_dilation(sleeve, np.ones((1, 7, 7)))
    assert found[~near].mean() < 0.01


@pytest.mark.parametrize("resting", [2 * FRAMES // 3, FRAMES - 1, FRAMES])
def test_finds_a_sleeve_that_rests(tmp_path: Path, rng: np.random.Generator, resting: int) -> None:
    """A forearm that stays for most of the time is no background, and what it hides then is.

    Neither is what it hides all the time, but a thing of its colour is that lies where no arm reaches.
    """
    sleeve = np.zeros((FRAMES, HEIGHT, WIDTH), dtype=bool)
    sleeve[:resting, 20:36, 8:24] = True
    hand = np.zeros_like(sleeve)
    hand[:, 26:32, 4:8] = True
    images = np.broadcast_to(room(rng), (FRAMES, HEIGHT, WIDTH, 3)).copy()
    images[:, 2:8, 60:70] = [0.1, 0.15, 0.9]
    images[hand] = [0.8, 0.6, 0.5]
    images[sleeve] = [0.1, 0.15, 0.9]
    # An arm in the same sleeve that moves.
    for t in range(FRAMES):
        images[t, 40:58, 4 * t : 4 * t + 24] = [0.1, 0.15, 0.9]
        sleeve[t, 40:58, 4 * t : 4 * t + 24] = True
    clip = painted_clip(tmp_path, to_bytes(images, rng), np.where(hand, np.uint8(150), np.uint8(0)))
    found = unknown_occluders(
        clip,
        {
            "right": wrist_at(np.full(FRAMES, 8.0), 28, (1.0, 0.0)),
            "left": wrist_at(4.0 * np.arange(FRAMES), 49, (1.0, 0.0)),
        },
    ).pixels
    assert found[sleeve].mean() > 0.95
    near = scipy.ndimage.binary_dilation(sleeve, np.ones((1, 9, 9)))
    assert found[~near].mean() < 0.02
    assert not found[:, 2:8, 60:70].any()


def test_background_that_a_sleeve_leaves_once_is_seen(tmp_path: Path, rng: np.random.Generator) -> None:
    """Neither look of a sleeve of two shades is the background; the one frame without it tells by colour."""
    bright, dark = [0.1, 0.15, 0.9], [0.1, 0.05, 0.5]
    images = np.broadcast_to(room(rng), (FRAMES, HEIGHT, WIDTH, 3)).copy()
    hand, rests = np.zeros((2, FRAMES, HEIGHT, WIDTH), dtype=bool)
    hand[:, 26:32, 4:8] = True
    images[hand] = [0.8, 0.6, 0.5]
    rests[:-1, 20:36, 8:24] = True
    images[:5, 20:36, 8:24], images[5:-1, 20:36, 8:24] = bright, dark
    for t in range(FRAMES):
        images[t, 40:49, 4 * t : 4 * t + 30], images[t, 49:58, 4 * t : 4 * t + 30] = bright, dark
    clip = painted_clip(tmp_path, to_bytes(images, rng), np.where(hand, np.uint8(150), np.uint8(0)))
    joints = {
        "right": wrist_at(np.full(FRAMES, 8.0), 28, (1.0, 0.0)),
        "left": wrist_at(4.0 * np.arange(FRAMES), 49, (1.0, 0.0)),
    }
    found = unknown_occluders(clip, joints).pixels
    assert found[rests].mean() > 0.95
    assert found[-1, 22:34, 12:22].mean() < 0.1


@pytest.mark.parametrize(
    ("light", "resting", "counts"),
    [
        ([0.5, 0.5, 0.5], False, False),
        ([0.5, 0.5, 0.5], True, False),
        ([0.75, 0.78, 0.8], False, False),  # what is left of the light is a little bluer
        ([0.75, 0.78, 0.8], True, False),
        ([0.2, 0.2, 0.2], False, True),  # too dark for a shadow
        ([0.5, 0.6, 0.8], False, True),  # too blue
    ],
)
def test_a_shadow_is_no_occluder(
    tmp_path: Path, rng: np.random.Generator, light: list[float], resting: bool, counts: bool
) -> None:
    """Unless it is next to a wrist, where it may be a sleeve; also if it is there most of the time."""
    step = 0 if resting else 5
    hand, shadow = moving_box(5, 5, 12, 12, 5), moving_box(30, 20, 12, 15, step)
    if resting:
        shadow[6:] = False
    images = np.broadcast_to(room(rng), (FRAMES, HEIGHT, WIDTH, 3)).copy()
    images[shadow] *= light
    images[hand] = [0.8, 0.6, 0.5]
    clip = painted_clip(tmp_path, to_bytes(images, rng), np.where(hand, np.uint8(150), np.uint8(0)))
    far = wrist_at(11 + 5 * np.arange(FRAMES), 5, (0.0, -1.0))
    found, moving = unknown_occluders(clip, {"right": far})
    assert moving is None
    if counts:
        assert found[shadow].mean() > 0.95
    else:
        assert found[shadow].mean() < 0.02 and found.mean() < 0.004
    if resting:
        return
    near = wrist_at(20.0 + step * np.arange(FRAMES), 35, (1.0, 0.0))
    found = unknown_occluders(clip, {"right": near}).pixels
    for t in range(FRAMES):
        assert found[t, 33:38, 22 + step * t : 28 + step * t].all()


def test_a_still_clip_has_none(tmp_path: Path, rng: np.random.Generator) -> None:
    hand = moving_box(25, 5, 12, 12, 5)
    images = np.broadcast_to(room(rng), (FRAMES, HEIGHT, WIDTH, 3)).copy()
    images[hand] = [0.8, 0.6, 0.5]
    clip = painted_clip(tmp_path, to_bytes(images, rng), np.where(hand, np.uint8(150), np.uint8(0)))
    found = unknown_occluders(clip, {})
    assert found.moving is None and not found.pixels.any()


def test_a_moving_camera_tells_nothing(tmp_path: Path, rng: np.random.Generator) -> None:
    wide = room(rng, WIDTH + 12 * FRAMES)
    images = np.stack([wide[:, 12 * t : 12 * t + WIDTH] for t in range(FRAMES)])
    hand = moving_box(25, 5, 12, 12, 1)
    clip = painted_clip(tmp_path, to_bytes(images, rng), np.where(hand, np.uint8(150), np.uint8(0)))
    assert not unknown_occluders(clip, {}).pixels.any()


def test_a_moving_camera_leaves_unknown_what_masks_lost(tmp_path: Path, rng: np.random.Generator) -> None:
    wide = room(rng, WIDTH + 12 * FRAMES)
    images = np.stack([wide[:, 12 * t : 12 * t + WIDTH] for t in range(FRAMES)])
    hand, thing = moving_box(10, 5, 12, 12, 2), moving_box(40, 20, 10, 10, 1)
    labels = np.where(hand, np.uint8(150), np.where(thing, np.uint8(50), np.uint8(0)))
    labels[2][hand[2]] = 0
    labels[4:6] = 0
    labels[7] = np.where(thing[7], np.uint8(50), np.uint8(0))
    labels[8] = 0
    found = unknown_occluders(painted_clip(tmp_path, to_bytes(images, rng), labels), {}).pixels
    # The hand of one frame, where it may be, and not the object that covers it.
    assert found[2][hand[2]].all() and not found[2][thing[2]].any() and found[2].mean() < 0.4
    # Frames without any mask say nothing, at the clip's end either.
    assert found[4:6].all() and found[8].all()
    # The hand has not come back by the end, so it may be gone.
    assert not found[[0, 1, 3, 6, 7]].any()


def test_border_pixels_of_a_mask_are_no_occluder(tmp_path: Path, rng: np.random.Generator) -> None:
    """Masks are cut sharp, images are not: one mixed pixel around a moving hand is nothing."""
    hand = moving_box(20, 5, 20, 20, 4)
    images = np.broadcast_to(room(rng), (FRAMES, HEIGHT, WIDTH, 3)).copy()
    rim = scipy.ndimage.binary_dilation(hand, scipy.ndimage.generate_binary_structure(2, 1)[None]) & ~hand
    images[rim] = 0.5 * images[rim] + 0.5 * np.array([1.0, 0.0, 0.0])
    images[hand] = [1.0, 0.0, 0.0]
    clip = painted_clip(tmp_path, to_bytes(images, rng), np.where(hand, np.uint8(150), np.uint8(0)))
    assert unknown_occluders(clip, {}).pixels.mean() < 0.002


def test_rows_that_are_never_background(tmp_path: Path, rng: np.random.Generator) -> None:
    images = np.broadcast_to(room(rng), (FRAMES, HEIGHT, WIDTH, 3)).copy()
    masks = np.zeros((FRAMES, HEIGHT, WIDTH), dtype=np.uint8)
    masks[:, 10:14] = 50
    assert not unknown_occluders(painted_clip(tmp_path / "a", to_bytes(images, rng), masks), {}).pixels.any()
    masks[:] = 50
    assert not unknown_occluders(painted_clip(tmp_path / "b", to_bytes(images, rng), masks), {}).pixels.any()


def test_large_images_are_compared_smaller(tmp_path: Path, rng: np.random.Generator) -> None:
    """Above 320 pixels the comparison is coarse, the answer is not."""
    scale = 7
    sleeve = moving_box(20, 5, 20, 16, 6)
    images = np.broadcast_to(room(rng), (FRAMES, HEIGHT, WIDTH, 3)).copy()
    images[sleeve] = [0.1, 0.15, 0.9]
    large = to_bytes(images, rng).repeat(scale, axis=1).repeat(scale, axis=2)
    clip = painted_clip(
        tmp_path,
        large,
        np.zeros(large.shape[:3], np.uint8),
        np.array([[700.0, 0, 280], [0, 700, 210], [0, 0, 1]]),
    )
    found = unknown_occluders(clip, {"right": wrist_at(6.0 * np.arange(FRAMES), 30, (1.0, 0.0))}).pixels
    assert found.shape == large.shape[:3]
    inside = sleeve.repeat(scale, axis=1).repeat(scale, axis=2)
    assert found[inside].mean() > 0.95
    assert found[~inside].mean() < 0.1

"""A camera that shakes before a still background: its turns are found, and what it sees is steady again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.ndimage
from scipy.spatial.transform import Rotation
from toy_clips import painted_clip

from bigs.train.start import shake
from bigs.train.start.background import unknown_occluders
from bigs.train.start.shake import camera_turns, steady_view

FRAMES, HEIGHT, WIDTH = 9, 90, 120
K = np.array([[110.0, 0.0, WIDTH / 2], [0.0, 110.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
# A wall that reaches further than any frame sees.
WALL_K = np.array([[110.0, 0.0, WIDTH], [0.0, 110.0, HEIGHT], [0.0, 0.0, 1.0]])
MIDDLE = FRAMES // 2


def swaying(degrees: float) -> np.ndarray:
    """Turns [T, 3, 3] from the middle frame's rays to those of each frame, about all axes."""
    times = np.arange(FRAMES) - MIDDLE
    angles = np.stack([np.sin(0.9 * times), np.sin(0.5 * times), 0.7 * np.sin(1.3 * times)], axis=-1)
    return Rotation.from_rotvec(np.radians(degrees) * angles).as_matrix()


def filmed(
    turns: np.ndarray, rng: np.random.Generator, tall: int = 13, resting: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pictures [T, H, W, 3] of a wall, with a hand that a mask shows and a sleeve that none does; both.

    A square of another sleeve, so many pixels wide, rests before the wall's middle.
    """
    wall = scipy.ndimage.gaussian_filter(rng.normal(size=(2 * HEIGHT, 2 * WIDTH, 3)), (4, 4, 0))
    wall = 0.5 + 0.15 * wall / wall.std()
    rests = np.zeros(wall.shape[:2])
    rests[HEIGHT : HEIGHT + resting, WIDTH : WIDTH + resting] = 1.0
    wall[rests > 0.5] = [0.1, 0.2, 0.8]
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    images = []
    hand, sleeve = np.zeros((2, FRAMES, HEIGHT, WIDTH), dtype=bool)
    for t, turn in enumerate(turns):
        there = np.stack([columns, rows, np.ones_like(rows)], -1) @ (WALL_K @ turn.T @ np.linalg.inv(K)).T
        at = [there[..., 1] / there[..., 2] - 0.5, there[..., 0] / there[..., 2] - 0.5]
        image = np.stack([scipy.ndimage.map_coordinates(wall[..., c], at, order=1) for c in range(3)], -1)
        hand[t, 30:50, 20 + 5 * t : 40 + 5 * t] = True
        sleeve[t, 50 : 50 + tall, 24 + 5 * t : 36 + 5 * t] = True
        image[hand[t]], image[sleeve[t]] = [0.8, 0.6, 0.5], [0.1, 0.2, 0.8]
        sleeve[t] |= (scipy.ndimage.map_coordinates(rests, at, order=1) > 0.5) & ~hand[t]
        images.append(image + rng.normal(0, 0.005, image.shape))
    return (255 * np.stack(images).clip(0, 1)).round().astype(np.uint8), hand, sleeve


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize("degrees", [0.0, 0.5, 3.0])
def test_turns_are_found_to_a_fraction_of_a_pixel(rng: np.random.Generator, degrees: float) -> None:
    """With a sleeve in the background that goes its own way."""
    true = swaying(degrees)
    images, hand, _ = filmed(true, rng, tall=40)
    found = camera_turns(images, ~hand, K)
    errors = Rotation.from_matrix(found.transpose(0, 2, 1) @ true).magnitude() * K[0, 0]
    assert errors.max() < 0.3
    np.testing.assert_array_equal(found[MIDDLE], np.eye(3))


def test_nothing_to_see_leaves_the_camera_still(rng: np.random.Generator) -> None:
    images, hand, _ = filmed(swaying(2.0), rng)
    assert (camera_turns(images, np.zeros_like(hand), K) == np.eye(3)).all()
    plain = np.full_like(images, 128)
    np.testing.assert_allclose(camera_turns(plain, ~hand, K), np.broadcast_to(np.eye(3), (FRAMES, 3, 3)))


def test_a_steady_picture_shows_what_frames_saw(rng: np.random.Generator) -> None:
    images, hand, _ = filmed(swaying(3.0), rng)
    view = steady_view(images, ~hand, K)
    assert view.shape[0] > HEIGHT and view.shape[1] > WIDTH
    gathered = view.gathered(images)
    assert gathered.dtype == np.uint8 and gathered.shape == (FRAMES, *view.shape, 3)
    for t in range(FRAMES):
        back = view.shown_in(t, gathered[t].astype(float), (HEIGHT, WIDTH))
        inner = (slice(2, -2), slice(2, -2))
        assert np.isfinite(back[inner]).all()
        assert np.median(np.abs(back - images[t])[inner]) < 2.0
    everywhere = view.gathered(np.ones_like(hand))
    assert everywhere.dtype == bool and everywhere.any(0).mean() > 0.9 > everywhere[0].mean()


def test_what_lies_beyond_the_picture_is_not_known(rng: np.random.Generator) -> None:
    images, hand, _ = filmed(swaying(0.0), rng)
    view = steady_view(images, ~hand, K)
    turned = view._replace(turns=swaying(30.0))
    assert np.isnan(turned.shown_in(0, np.ones(view.shape), (HEIGHT, WIDTH))).any()


@pytest.mark.parametrize("degrees", [0.5, 3.0])
def test_a_run_finds_sleeves_before_a_camera_that_sways(
    tmp_path: Path, rng: np.random.Generator, degrees: float
) -> None:
    """Wherever they are: no joints say where an arm may be."""
    images, hand, sleeve = filmed(swaying(degrees), rng)
    clip = painted_clip(tmp_path, images, np.where(hand, np.uint8(150), np.uint8(0)), K)
    found, moving = unknown_occluders(clip, {})
    assert moving == "turns, as the camera does"
    assert found[sleeve].mean() > 0.9
    near = scipy.ndimage.binary_dilation(sleeve, np.ones((1, 9, 9)))
    assert found[~near].mean() < 0.02


def test_a_sleeve_that_rests_hides_the_wall_all_the_time(tmp_path: Path, rng: np.random.Generator) -> None:
    """What it hides no frame shows, but it has the colours of another that moves, and an arm may be there."""
    images, hand, sleeve = filmed(swaying(1.5), rng, tall=40, resting=14)
    clip = painted_clip(tmp_path, images, np.where(hand, np.uint8(150), np.uint8(0)), K)
    rests, moves = np.full((2, FRAMES, 21, 3), 0.5)
    rests[..., :2] = (-0.03, 0.0)
    rests[:, 4, 0] -= 0.1  # the arm goes right
    moves[..., 0] = ((30 + 5 * np.arange(FRAMES) - WIDTH / 2) / 110.0 * 0.5)[:, None]
    moves[..., 1] = (50 - HEIGHT / 2) / 110.0 * 0.5
    moves[:, 4, 1] -= 0.1  # down
    found, moving = unknown_occluders(clip, {"right": rests, "left": moves})
    assert moving == "turns, as the camera does"
    assert found[sleeve].mean() > 0.9
    near = scipy.ndimage.binary_dilation(sleeve, np.ones((1, 9, 9)))
    assert found[~near].mean() < 0.02


def test_turns_that_cannot_be_make_no_endless_picture(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    images, hand, _ = filmed(swaying(0.0), rng)
    monkeypatch.setattr(shake, "camera_turns", lambda *_: swaying(100.0))
    view = steady_view(images, ~hand, K)
    assert view.shape[0] <= 3 * HEIGHT and view.shape[1] <= 3 * WIDTH
    assert view.gathered(images).shape == (FRAMES, *view.shape, 3)

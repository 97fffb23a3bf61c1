"""Arms and sleeves before a background that moves: found by place and colour."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import arm_clips
import numpy as np
import pytest
import scipy.ndimage
from arm_clips import FRAMES, HEIGHT, WIDTH, K, hand_and_arm
from PIL import Image
from toy_clips import painted_clip

from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.train.fit import fit
from bigs.train.plan.presets import SMOKE
from bigs.train.start.arms import arm_reach, arms
from bigs.train.start.background import unknown_occluders
from bigs.types import Side

BLUE = np.array([0.1, 0.15, 0.9])
# At 4 mm a pixel: how far the place alone can tell an arm, from the wrist.
CUFF_PIXELS = 0.05 / 0.004


def street(rng: np.random.Generator) -> np.ndarray:
    """[T, H, W, 3]: structure that passes by."""
    wide = rng.normal(size=(HEIGHT, WIDTH + 9 * FRAMES, 3))
    wide = scipy.ndimage.gaussian_filter(wide, (1.5, 1.5, 0))
    wide = 0.5 + 0.2 * wide / wide.std()
    return np.stack([wide[:, 9 * t : 9 * t + WIDTH] for t in range(FRAMES)]).clip(0, 1)


def filmed(sleeve: np.ndarray | None, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Pictures [T, H, W, 3] uint8 and masks of a hand whose arm has that colour, or the background's."""
    hand, arm = hand_and_arm()
    images = street(rng)
    images[hand] = [0.8, 0.6, 0.5]
    if sleeve is not None:
        images[arm] = sleeve
    noisy = images + rng.normal(0, 0.01, images.shape)
    return (255 * noisy.clip(0, 1)).round().astype(np.uint8), hand


def found_in(images: np.ndarray, hand: np.ndarray, joints: dict[Side, np.ndarray]) -> np.ndarray:
    return arms(images, ~hand, arm_reach(joints, K, hand.shape), joints, K)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_a_sleeve_is_found_by_its_colour(rng: np.random.Generator) -> None:
    images, hand = filmed(BLUE, rng)
    arm = hand_and_arm()[1]
    found = found_in(images, hand, {"right": arm_clips.joints()})
    assert found[arm].mean() > 0.9
    near = scipy.ndimage.binary_dilation(arm, np.ones((1, 9, 9)))
    assert found[~near].mean() < 0.005
    assert not found[hand].any()


def test_a_sleeve_like_the_background_is_known_by_its_place(rng: np.random.Generator) -> None:
    images, hand = filmed(None, rng)
    arm = hand_and_arm()[1]
    found = found_in(images, hand, {"right": arm_clips.joints()})
    cuff = arm & (scipy.ndimage.distance_transform_edt(~hand) < CUFF_PIXELS)
    assert found[cuff].all() and not found[hand].any()
    far = scipy.ndimage.distance_transform_edt(~hand[0]) > 3 * CUFF_PIXELS
    assert found[0][far].mean() < 0.1


def test_without_hands_there_are_none(rng: np.random.Generator) -> None:
    images, hand = filmed(BLUE, rng)
    assert not found_in(images, hand, {}).any()


def test_things_of_the_same_colour_elsewhere_are_none(rng: np.random.Generator) -> None:
    images, hand = filmed(BLUE, rng)
    images[:, 5:12, 5:12] = (255 * BLUE).astype(np.uint8)
    assert not found_in(images, hand, {"right": arm_clips.joints()})[:, :15, :15].any()


def test_an_arm_that_comes_from_the_camera_is_seen_before_it() -> None:
    """As of a camera on the head: the wrist is 30 cm away, the elbow behind the camera."""
    joints = np.tile([0.0, 0.02, 0.3], (FRAMES, 21, 1))
    joints[:, 4] += [0.0, -0.03, 0.08]  # away from the camera and up, so that the arm comes from below
    reach = arm_reach({"right": joints}, K, (FRAMES, HEIGHT, WIDTH))
    assert reach[:, -1, WIDTH // 2].all() and reach[:, HEIGHT // 2 + 10, WIDTH // 2].all()
    assert not reach[:, 0].any()


def test_a_wrist_at_the_camera_tells_nothing() -> None:
    joints = np.tile([0.0, 0.0, 0.01], (FRAMES, 21, 1))
    joints[:, 4, 2] += 0.08
    assert not arm_reach({"right": joints}, K, (FRAMES, HEIGHT, WIDTH)).any()


def test_a_wrist_behind_the_camera_tells_nothing(rng: np.random.Generator) -> None:
    images, hand = filmed(BLUE, rng)
    assert not found_in(images, hand, {"right": -arm_clips.joints()}).any()


@pytest.mark.parametrize("scale", [1, 5])
def test_a_run_looks_for_them_where_the_camera_moves(
    tmp_path: Path, rng: np.random.Generator, scale: int
) -> None:
    """Also where pictures are so large that they are compared smaller."""
    images, hand = filmed(BLUE, rng)
    images, labels = (
        values.repeat(scale, axis=1).repeat(scale, axis=2)
        for values in (images, np.where(hand, np.uint8(150), np.uint8(0)))
    )
    clip = painted_clip(tmp_path, images, labels, np.diag([scale, scale, 1.0]) @ K)
    assert not unknown_occluders(clip, {}).pixels.any()
    found, moving = unknown_occluders(clip, {"right": arm_clips.joints()})
    assert moving is not None and moving.startswith("moves")
    arm = hand_and_arm()[1].repeat(scale, axis=1).repeat(scale, axis=2)
    assert found[arm].mean() > 0.9
    assert found[~arm].mean() < 0.05


@pytest.mark.parametrize("armed", [True, False])
def test_before_a_wall_of_its_colour_a_sleeve_goes_on(
    tmp_path: Path, rng: np.random.Generator, armed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And where there is no arm a wall is one. The hand goes up and down, which shows what is behind it."""
    hand, arm = hand_and_arm()
    places = arm_clips.joints()
    for t in range(FRAMES):
        up = [-20, 0, 20][t % 3]
        hand[t], arm[t] = np.roll(hand[t], up, axis=0), np.roll(arm[t], up, axis=0)
        places[t, :, 1] += 0.004 * up
    images = np.tile(street(rng)[0], (FRAMES, 1, 1, 1))
    images[:, :, 64:84] = BLUE
    if armed:
        images[arm] = BLUE
    images[hand] = [0.8, 0.6, 0.5]
    noisy = images + rng.normal(0, 0.01, images.shape)
    labels = np.where(hand, np.uint8(150), np.uint8(0))
    clip = painted_clip(tmp_path, (255 * noisy.clip(0, 1)).round().astype(np.uint8), labels, K)
    found, moving = unknown_occluders(clip, {"right": places})
    assert moving is None
    if not armed:
        assert not found.any()
        return
    middle = scipy.ndimage.binary_erosion(arm, np.ones((1, 11, 1)))  # 14 mm to either side
    cuff = middle & (scipy.ndimage.distance_transform_edt(~hand) < CUFF_PIXELS)
    monkeypatch.setattr("bigs.train.start.arms._SLEEVED", 1.0)
    without = unknown_occluders(clip, {"right": places}).pixels
    assert found[cuff].mean() > 0.99 and without[cuff].mean() < 0.8
    near = scipy.ndimage.binary_dilation(arm, np.ones((1, 7, 7)))
    assert not found[~near].any()


def test_the_report_says_that_the_background_moves(
    tiny: Clip, both_hands: dict[Side, HandModel], tmp_path: Path, rng: np.random.Generator
) -> None:
    plan = replace(SMOKE, stages=())
    assert "background" not in fit(tiny, both_hands, plan)[1].facts
    paths = tuple(tmp_path / path.name for path in tiny.image_paths)
    for t, path in enumerate(paths):
        noise = rng.integers(0, 256, (tiny.height, tiny.width, 3), dtype=np.uint8)
        Image.fromarray(np.where(tiny.mask(t)[..., None] == 0, noise, tiny.image(t))).save(path)
    report = fit(replace(tiny, image_paths=paths), both_hands, plan)[1]
    assert report.facts["background"].startswith("moves")

"""Masks that go on over the arm are cut at the wrist; what lies beyond may hide things."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import arm_clips
import numpy as np
import pytest
from arm_clips import FRAMES, K, hand_and_arm
from PIL import Image
from toy_clips import painted_clip

from bigs.commands.clips.convert import ConvertPlan, convert
from bigs.commands.clips.open import open_clip
from bigs.data.base import Clip
from bigs.data.excerpt import excerpt
from bigs.data.images import read_mask
from bigs.data.oddities.forearms import KNUCKLE, without_arms
from bigs.hand import JOINT_NAMES, HandModel
from bigs.train.start.background import unknown_occluders
from bigs.train.start.initial import initial_trajectory
from bigs.types import MASK_VALUES, Side


def filmed(folder: Path, armed: np.ndarray) -> Clip:
    """A clip in whose frames `armed` [T] the mask of the right hand goes on over the arm."""
    hand, arm = hand_and_arm()
    labels = np.where(hand | (arm & armed[:, None, None]), np.uint8(150), np.uint8(0))
    images = np.random.default_rng(0).integers(0, 256, (*labels.shape, 3), dtype=np.uint8)
    return painted_clip(folder, images, labels, K)


ALL = np.ones(FRAMES, dtype=bool)


def test_lines_start_at_the_middle_finger() -> None:
    assert JOINT_NAMES[KNUCKLE] == "middle1"


@pytest.mark.parametrize("armed", [ALL, np.arange(FRAMES) % 4 == 0], ids=["all frames", "some frames"])
def test_arms_are_cut_off(tmp_path: Path, armed: np.ndarray) -> None:
    clip = without_arms(filmed(tmp_path, armed), {"right": arm_clips.joints()})
    hand, arm = hand_and_arm()
    assert clip.notes == ("masks: those of hands go on over the arms; cut at the wrists",)
    for t in range(FRAMES):
        labels, beyond = clip.mask(t), clip.arm(t)
        assert not labels[arm[t]].any()
        assert (labels[hand[t]] == 150).mean() > 0.8  # all but the margin at the wrist
        assert beyond[arm[t]].all() == armed[t]
        assert ((labels == 150) | beyond == (hand[t] | (arm[t] & armed[t]))).all()
        assert clip.mask_areas["right"][t] == (labels == 150).sum() > 0


def test_hands_alone_stay_whole(tmp_path: Path) -> None:
    clip = filmed(tmp_path, ~ALL)
    assert without_arms(clip, {"right": arm_clips.joints()}) is clip
    assert not clip.arm(0).any()


def test_a_wrong_estimate_cuts_no_hand(tmp_path: Path) -> None:
    wrong = arm_clips.joints()
    wrong[5] = wrong[5, ::-1] - [0.08, 0.0, 0.0]
    clip = without_arms(filmed(tmp_path, ALL), {"right": wrong})
    assert (clip.mask(5)[hand_and_arm()[0][5]] == 150).mean() > 0.8


def test_frames_without_a_hand_say_nothing(tmp_path: Path) -> None:
    clip = filmed(tmp_path, ALL)
    assert without_arms(clip, {"left": arm_clips.joints()}) is clip


def test_both_masks_are_cut_where_one_shows_an_arm(tmp_path: Path) -> None:
    clip = filmed(tmp_path, ALL)
    elsewhere = arm_clips.joints() - [0.0, 0.1, 0.0]
    cut = without_arms(clip, {"right": arm_clips.joints(), "left": elsewhere})
    assert cut.arms is not None and set(cut.arms) == {"right", "left"}


def test_parts_of_a_clip_are_cut_the_same(tmp_path: Path) -> None:
    clip = without_arms(filmed(tmp_path, ALL), {"right": arm_clips.joints()})
    part = excerpt(clip, np.array([7, 3]))
    for new, old in enumerate((7, 3)):
        np.testing.assert_array_equal(part.mask(new), clip.mask(old))
        np.testing.assert_array_equal(part.arm(new), clip.arm(old))


def test_what_is_cut_off_may_hide_things(tmp_path: Path) -> None:
    """Whether or not the background tells."""
    clip = without_arms(filmed(tmp_path, ALL), {"right": arm_clips.joints()})
    arm = hand_and_arm()[1]
    assert unknown_occluders(clip, {}).pixels[arm].all()


@pytest.fixture(scope="module")
def armed_clip(
    tiny_clip: Path, both_hands: dict[Side, HandModel], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The tiny clip with masks that go on from the wrists to the picture's border."""
    folder = tmp_path_factory.mktemp("armed") / "clip"
    shutil.copytree(tiny_clip, folder)
    clip = open_clip(folder, both_hands)
    for side, places in initial_trajectory(clip, both_hands).joints.items():
        for t, path in enumerate(clip.mask_paths):
            labels = np.array(Image.open(path))
            wrist, knuckle = ((clip.K @ place)[:2] / place[2] for place in places[t, [0, 4]])
            step = (wrist - knuckle) / np.linalg.norm(wrist - knuckle)
            for distance in range(200):
                x, y = np.round(wrist + distance * step).astype(int)
                box = labels[max(y - 6, 0) : max(y + 7, 0), max(x - 6, 0) : max(x + 7, 0)]
                box[box == 0] = MASK_VALUES[side]
            Image.fromarray(labels).save(path)
    return folder


def test_opening_a_clip_cuts_them_off(
    armed_clip: Path, tiny: Clip, both_hands: Mapping[Side, HandModel]
) -> None:
    clip = open_clip(armed_clip, both_hands)
    assert any(note.endswith("over the arms; cut at the wrists") for note in clip.notes)
    pairs = [(np.isin(tiny.mask(t), (150, 250)), np.isin(clip.mask(t), (150, 250))) for t in range(len(clip))]
    hands, now = (np.stack(masks) for masks in zip(*pairs, strict=True))
    # Of hands that the object hides but for their wrists little is left.
    assert (now & hands).sum() > 0.6 * hands.sum()
    assert (now & ~hands).sum() < 0.1 * hands.sum()


def test_converted_clips_keep_the_masks_of_the_files(
    armed_clip: Path, both_hands: Mapping[Side, HandModel], tmp_path: Path
) -> None:
    convert(armed_clip, tmp_path / "new", ConvertPlan())
    again, before = (open_clip(folder, both_hands) for folder in (tmp_path / "new", armed_clip))
    for t in range(len(before)):
        np.testing.assert_array_equal(read_mask(again.mask_paths[t]), read_mask(before.mask_paths[t]))
        np.testing.assert_array_equal(again.mask(t), before.mask(t))

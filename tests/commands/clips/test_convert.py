"""A converted clip is the same clip: poses, cameras, pictures and truth, in the layout that runs need."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import Answer, assert_refused
from mano_twin import odd_models
from PIL import Image

from bigs.checks import InputError
from bigs.commands.clips import convert as converting
from bigs.commands.clips.convert import ConvertPlan, convert
from bigs.commands.clips.open import open_clip
from bigs.commands.clips.truth import load_truth, pose_annotation
from bigs.data.base import Clip
from bigs.data.formats.hold import load_hold
from bigs.data.formats.writers import write_arctic
from bigs.data.ground_truth import load_annotation
from bigs.hand import HandModel, load_hand_models
from bigs.train.start.initial import initial_trajectory
from bigs.types import Side

TOLERANCE = 2e-6


@pytest.fixture
def models(both_hands: dict[Side, HandModel], monkeypatch: pytest.MonkeyPatch) -> dict[Side, HandModel]:
    """Hands with a mean pose and unequal sides in place of the built-in ones."""
    odd = odd_models(both_hands)
    monkeypatch.setattr(converting, "load_hand_models", lambda path: odd)
    return odd


@pytest.fixture
def arctic(tmp_path: Path, tiny: Clip, tiny_clip: Path) -> Path:
    """The tiny clip's truth as ARCTIC has it, with its masks beside."""
    images = [tiny.image(t) for t in range(len(tiny))]
    folder = write_arctic(
        tmp_path / "arctic",
        load_annotation(tiny_clip),
        subject="s01",
        sequence="bottle_grab_01",
        images=images,
    )
    masks = tmp_path / "arctic" / "masks" / "s01" / "bottle_grab_01" / "1"
    masks.mkdir(parents=True)
    for t in range(len(tiny)):
        Image.fromarray(tiny.mask(t)).save(masks / f"{100 + t:05d}.png")
    return folder


def test_an_arctic_sequence_becomes_a_clip_with_its_truth(
    tmp_path: Path, arctic: Path, tiny: Clip, models: dict[Side, HandModel]
) -> None:
    out = tmp_path / "clip"
    convert(arctic, out, ConvertPlan(from_truth=True))
    clip = load_hold(out)
    assert clip.name == "arctic_s01_bottle_grab_01_1" and not clip.annotated
    np.testing.assert_allclose(clip.K, tiny.K, atol=1e-4)
    for t in range(len(tiny)):
        np.testing.assert_array_equal(clip.mask(t), tiny.mask(t))
        assert np.abs(clip.image(t).astype(int) - tiny.image(t)).mean() < 6  # it was a JPEG
    names = [f"{100 + t:05d}.jpg" for t in range(len(tiny))]
    expected = load_truth(arctic, names, models)
    start, truth = initial_trajectory(clip, models), load_truth(out, (), {})
    assert truth.frame_names == tuple(names)
    for side in ("right", "left"):
        for found in (start, truth):
            np.testing.assert_allclose(found.joints[side], expected.joints[side], atol=TOLERANCE)
            np.testing.assert_allclose(found.verts[side], expected.verts[side], atol=TOLERANCE)
    assert start.object_verts is not None
    np.testing.assert_allclose(start.object_verts, expected.object_verts, atol=TOLERANCE)
    np.testing.assert_allclose(truth.object_verts, expected.object_verts, atol=TOLERANCE)
    again = pose_annotation(load_annotation(out), models)
    np.testing.assert_allclose(again.verts["left"], expected.verts["left"], atol=TOLERANCE)


def test_frames_and_size_can_be_chosen(tmp_path: Path, tiny: Clip, tiny_clip: Path) -> None:
    convert(tiny_clip, tmp_path / "clip", ConvertPlan(every=3, width=60))
    clip = load_hold(tmp_path / "clip")
    assert clip.frame_names == tiny.frame_names[::3]
    assert (clip.width, clip.height) == (60, 45)
    np.testing.assert_allclose(clip.K[:2], tiny.K[:2] / 2, atol=1e-4)
    np.testing.assert_array_equal(np.unique(clip.mask(1)), np.unique(tiny.mask(3)))
    blocks = tiny.image(3).reshape(45, 2, 60, 2, 3).mean(axis=(1, 3))
    assert np.abs(clip.image(1) - blocks).max() <= 1.0
    # A point is where it was, in half as many pixels.
    assert clip.object is not None and tiny.object is not None
    pixels = []
    for one, t in ((clip, 1), (tiny, 3)):
        assert one.object is not None
        to_cam = one.cam_from_world[t]
        seen = (one.object.points_world()[t] @ to_cam[:3, :3].T + to_cam[:3, 3]) @ one.K.T
        pixels.append(seen[:, :2] / seen[:, 2:])
    np.testing.assert_allclose(2 * pixels[0], pixels[1], atol=1e-3)


def test_frames_a_second_go_on(
    call: Callable[..., Answer], tmp_path: Path, tiny: Clip, tiny_clip: Path
) -> None:
    assert tiny.fps == 30.0
    convert(tiny_clip, tmp_path / "half", ConvertPlan(every=2))
    assert load_hold(tmp_path / "half").fps == 15.0
    convert(tmp_path / "half", tmp_path / "sixth", ConvertPlan(every=3))
    assert load_hold(tmp_path / "sixth").fps == 5.0
    # Who knows better than the files says so, of the clip as it is.
    assert call("convert", tiny_clip, "--out", tmp_path / "b", "--fps", "50", "--every", "2").code == 0
    assert load_hold(tmp_path / "b").fps == 25.0
    assert "6, 120 x 90, 25 a second" in call("info", tmp_path / "b").out
    assert_refused(call("convert", tiny_clip, "--out", tmp_path / "c", "--fps", "0"), "--fps: expected", "0")


def test_the_limited_view_is_a_quarter(call: Callable[..., Answer], tmp_path: Path, tiny_clip: Path) -> None:
    answer = call("convert", tiny_clip, "--out", tmp_path / "clip", "--view", "limited")
    assert answer.code == 0 and "limited: directions within" in answer.out
    clip = load_hold(tmp_path / "clip")
    assert len(clip) == 3 and not (tmp_path / "clip" / "gt.npz").exists()


def test_frames_without_truth_are_left_out(
    tmp_path: Path, arctic: Path, models: dict[Side, HandModel]
) -> None:
    raw = arctic.parents[3] / "meta" / "misc.json"
    raw.write_text(raw.read_text().replace('"ioi_offset": 100', '"ioi_offset": 103'))
    rows = dict(convert(arctic, tmp_path / "clip", ConvertPlan(from_truth=True)))
    assert rows["left out"] == "3 frames without annotation"
    clip = load_hold(tmp_path / "clip")
    assert clip.frame_names[0] == "00103.jpg" and len(clip) == 9
    assert len(load_truth(tmp_path / "clip", (), {}).frame_names) == 9


def test_an_object_that_bends_is_left_to_the_data_set(
    tmp_path: Path, arctic: Path, models: dict[Side, HandModel]
) -> None:
    file = arctic.parents[3] / "raw_seqs" / "s01" / "bottle_grab_01.object.npy"
    poses = np.load(file)
    poses[:, 0] = 0.3
    np.save(file, poses)
    rows = dict(convert(arctic, tmp_path / "clip", ConvertPlan(from_truth=True)))
    assert "it bends" in rows["object"]
    truth = load_truth(tmp_path / "clip", (), {})
    assert truth.object_verts is None and set(truth.joints) == {"right", "left"}


def test_what_is_refused(call: Callable[..., Answer], tmp_path: Path, arctic: Path, tiny_clip: Path) -> None:
    out = tmp_path / "clip"
    assert_refused(call("convert", arctic, "--out", out), "found a data set's ground truth", "--from-truth")
    assert_refused(call("convert", tiny_clip, "--out", tiny_clip), "expected no clip there yet")
    assert_refused(call("convert", tiny_clip, "--out", out, "--every", "0"), "--every, --width: expected")
    assert_refused(call("convert", tiny_clip, "--out", out, "--masks", tiny_clip), "expected frames (.png)")
    (arctic.parents[3] / "masks").rename(tmp_path / "masks")
    assert_refused(call("convert", arctic, "--out", out, "--from-truth"), "expected label masks (--masks)")
    assert not out.exists()
    masks = tmp_path / "masks" / "s01" / "bottle_grab_01" / "1"
    assert call("convert", arctic, "--out", out, "--from-truth", "--masks", masks).code == 0
    assert load_hold(out).has_pixels("object").any()
    assert call("reconstruct", arctic, "--out", tmp_path / "run", "--preset", "smoke").code == 2
    with pytest.raises(InputError, match="expected a clip folder"):
        convert(tmp_path / "absent", tmp_path / "new", ConvertPlan())


def test_pictures_of_a_wavering_exposure_go_on_as_they_are(tmp_path: Path, tiny_clip: Path) -> None:
    source = Path(shutil.copytree(tiny_clip, tmp_path / "source"))
    files = sorted((source / "build" / "image").iterdir())
    for t in (2, 5):
        Image.fromarray((0.8 * np.array(Image.open(files[t]))).astype(np.uint8)).save(files[t])
    models = load_hand_models(None)
    opened = open_clip(source, models)
    assert opened.gains is not None
    assert np.flatnonzero((np.abs(opened.gains - 1.0) > 0.05).any(1)).tolist() == [2, 5]
    convert(source, tmp_path / "clip", ConvertPlan())
    for t, (before, after) in enumerate(
        zip(files, sorted((tmp_path / "clip" / "build" / "image").iterdir()), strict=True)
    ):
        np.testing.assert_array_equal(np.array(Image.open(before)), np.array(Image.open(after)), str(t))

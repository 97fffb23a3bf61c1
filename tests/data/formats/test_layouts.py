"""Clips of each layout are recognised and read; what is wrong with one is said in one sentence."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_clip import FRAMES, HEIGHT, WIDTH, small_annotation, small_masks

from bigs.checks import InputError
from bigs.data.formats.annotation import Annotation
from bigs.data.formats.arctic import find_arctic, load_arctic
from bigs.data.formats.ho3d import CV_FROM_GL, load_ho3d
from bigs.data.formats.layouts import layout_of, load_clip
from bigs.data.formats.writers import write_arctic, write_ho3d
from bigs.unpickle import load_npy

NO_MEAN = np.zeros((15, 3))


@pytest.fixture
def annotation() -> Annotation:
    return small_annotation()


@pytest.fixture
def arctic(tmp_path: Path, annotation: Annotation) -> Path:
    images = np.zeros((FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8)
    return write_arctic(tmp_path / "arctic", annotation, subject="s01", sequence="box_grab_01", images=images)


@pytest.fixture
def ho3d(tmp_path: Path, annotation: Annotation) -> Path:
    upside_down = replace(annotation, cam_from_world=np.repeat(CV_FROM_GL[None], FRAMES, axis=0))
    return write_ho3d(
        tmp_path / "ho3d",
        upside_down,
        clip="SM1",
        object_name="006_mustard_bottle",
        images=np.full((FRAMES, HEIGHT, WIDTH, 3), 90, dtype=np.uint8),
        hands_mean=NO_MEAN,
    )


def write_masks(folder: Path, stems: list[str]) -> None:
    folder.mkdir(parents=True)
    for stem, mask in zip(stems, small_masks(), strict=True):
        Image.fromarray(mask).save(folder / f"{stem}.png")


def test_each_layout_is_recognised(arctic: Path, ho3d: Path, write_small: Callable[..., Path]) -> None:
    small = write_small()
    for place in (small, small / "build"):
        assert layout_of(place) == "hold"
    root = arctic.parents[3]
    for place in (root, arctic, root / "s01" / "box_grab_01", root / "raw_seqs" / "s01", arctic.parent):
        assert layout_of(place) == "arctic"
        assert load_clip(place, NO_MEAN).name == "arctic_s01_box_grab_01_1"
    for place in (ho3d, ho3d / "rgb", ho3d.parents[1]):
        assert layout_of(place) == "ho3d"
        assert load_clip(place, NO_MEAN).name == "hold_SM1_ho3d"
    with pytest.raises(InputError, match=r"expected a clip folder \(HOLD .* found another folder"):
        layout_of(small.parent)
    with pytest.raises(InputError, match="found nothing"):
        layout_of(small / "absent")


def test_an_arctic_clip_is_annotated_images(arctic: Path, annotation: Annotation) -> None:
    clip = load_arctic(arctic)
    assert clip.annotated and clip.mask_paths == () and clip.frame_names[0] == "00100.jpg"
    assert (len(clip), clip.width, clip.height) == (FRAMES, WIDTH, HEIGHT)
    assert not any(areas.any() for areas in clip.mask_areas.values())
    for side, track in annotation.hands.items():
        for field in ("global_orient", "hand_pose", "transl", "betas", "valid"):
            np.testing.assert_allclose(getattr(clip.hands[side], field), getattr(track, field), atol=1e-12)
    assert clip.object is not None
    np.testing.assert_allclose(
        clip.object.points_world()[2], annotation.object.verts + np.array([0, 0, 0.5]), atol=1e-9
    )
    # HOLD's camera would stand a metre before the object.
    in_camera = np.median(clip.object.points_world().mean(axis=1), axis=0)
    np.testing.assert_allclose(in_camera * [1, -1, -1] + clip.normalize_shift, [0, 0, -1], atol=1e-9)
    write_masks(
        arctic.parents[3] / "masks" / "s01" / "box_grab_01" / "1", [f"{100 + t:05d}" for t in range(FRAMES)]
    )
    np.testing.assert_array_equal(load_arctic(arctic).has_pixels("left"), [True, True, False, True, True])


def test_an_ho3d_clip_is_annotated_images(ho3d: Path, annotation: Annotation) -> None:
    mean = 0.1 * np.random.default_rng(0).normal(size=(15, 3))
    clip = load_ho3d(ho3d, mean)
    assert (
        clip.annotated and set(clip.hands) == {"right"} and clip.image(3).mean() == pytest.approx(90, abs=1)
    )
    expected = annotation.hands["right"]
    np.testing.assert_allclose(clip.hands["right"].hand_pose + mean, expected.hand_pose, atol=1e-12)
    np.testing.assert_allclose(clip.hands["right"].transl, expected.transl, atol=1e-12)
    np.testing.assert_allclose(clip.cam_from_world[1], CV_FROM_GL)
    write_masks(ho3d / "mask", [f"{t:04d}" for t in range(FRAMES)])
    assert len(load_ho3d(ho3d, mean).mask_paths) == FRAMES


def test_the_evaluation_split_tells_no_hand_pose(tmp_path: Path, annotation: Annotation) -> None:
    upside_down = replace(annotation, cam_from_world=np.repeat(CV_FROM_GL[None], FRAMES, axis=0))
    folder = write_ho3d(
        tmp_path,
        upside_down,
        clip="SM1",
        object_name="box",
        images=np.zeros((FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8),
        hands_mean=NO_MEAN,
        split="evaluation",
    )
    clip = load_ho3d(folder, NO_MEAN)
    assert clip.hands == {} and clip.object is not None


def test_without_templates_there_is_no_object(arctic: Path, ho3d: Path) -> None:
    (arctic.parents[3] / "meta" / "object_vtemplates").rename(arctic.parents[3] / "elsewhere")
    assert load_arctic(arctic).object is None
    (ho3d.parents[1] / "models").rename(ho3d.parents[1] / "elsewhere")
    assert load_ho3d(ho3d, NO_MEAN).object is None


def test_the_shape_may_stand_in_every_row(arctic: Path) -> None:
    file = arctic.parents[3] / "raw_seqs" / "s01" / "box_grab_01.mano.npy"
    hands = load_npy(file)
    hands["right"]["shape"] = np.repeat(hands["right"]["shape"][None], FRAMES, axis=0)
    before = load_arctic(arctic).hands["right"].betas
    np.save(file, np.array(hands, dtype=np.object_))
    np.testing.assert_array_equal(load_arctic(arctic).hands["right"].betas, before)


def edit_json(file: Path, change: Callable[[dict], None]) -> None:
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (
            lambda r: (r / "meta" / "misc.json").unlink(),
            "misc.json: expected a JSON file, found no such file",
        ),
        (lambda r: (r / "meta" / "misc.json").write_text("{"), "misc.json: expected JSON"),
        (
            lambda r: edit_json(r / "meta" / "misc.json", lambda m: m.pop("s01")),
            "misc.json: s01: expected this",
        ),
        (
            lambda r: edit_json(r / "meta" / "misc.json", lambda m: m["s01"].pop("ioi_offset")),
            "s01.ioi_offset: expected this field",
        ),
        (
            lambda r: edit_json(r / "meta" / "misc.json", lambda m: m["s01"].update(world2cam=[[1.0]])),
            r"s01.world2cam: expected shape \[8, 4, 4\]",
        ),
        (
            lambda r: edit_json(r / "meta" / "misc.json", lambda m: m["s01"].update(ioi_offset=900)),
            "mano.npy: expected the images 00100.jpg to 00104.jpg among its 5 frames from 900 on, found none",
        ),
        (
            lambda r: np.save(r / "raw_seqs" / "s01" / "box_grab_01.object.npy", np.zeros((3, 7))),
            r"object.npy: expected shape \[5, 7\], found \[3, 7\]",
        ),
        (
            lambda r: next(r.glob("images/s01/*/1/*.jpg")).rename(r / "images/s01/box_grab_01/1/first.jpg"),
            "expected frames named by number",
        ),
    ],
)
def test_what_is_wrong_with_an_arctic_folder(
    arctic: Path, damage: Callable[[Path], None], words: str
) -> None:
    damage(arctic.parents[3])
    with pytest.raises(InputError, match=words):
        load_arctic(arctic)


def test_an_arctic_path_names_one_sequence(arctic: Path, annotation: Annotation) -> None:
    root = arctic.parents[3]
    images = np.zeros((FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8)
    write_arctic(root, annotation, subject="s02", sequence="mixer_use_01", images=images)
    with pytest.raises(InputError, match="found sequences s01/box_grab_01, s02/mixer_use_01"):
        find_arctic(root)
    view = find_arctic(root / "s02")
    assert view is not None and (view.sequence, view.view) == ("mixer_use_01", 1)
    assert load_arctic(root / "s02").name == "arctic_s02_mixer_use_01_1"
    with pytest.raises(InputError, match="expected a view from 0 to 8"):
        find_arctic(root / "s01" / "box_grab_01" / "9")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: (f / "meta" / "0002.pkl").unlink(), "0002.pkl: expected the annotation of a frame"),
        (lambda f: (f / "meta" / "0002.pkl").write_bytes(b"junk"), "0002.pkl: expected a readable pickle"),
        (lambda f: [p.unlink() for p in (f / "rgb").iterdir()], "rgb: expected frames"),
    ],
)
def test_what_is_wrong_with_an_ho3d_clip(ho3d: Path, damage: Callable[[Path], None], words: str) -> None:
    damage(ho3d)
    with pytest.raises(InputError, match=words):
        load_ho3d(ho3d, NO_MEAN)


def test_an_ho3d_release_of_several_clips_is_not_one(
    tmp_path: Path, ho3d: Path, annotation: Annotation
) -> None:
    (ho3d.parent / "AB2").mkdir()
    (ho3d / "meta").rename(ho3d.parent / "AB2" / "meta")
    (ho3d / "meta").mkdir()
    with pytest.raises(InputError, match="expected one clip of HO-3D, found 2: train/AB2, train/SM1"):
        layout_of(ho3d.parents[1])

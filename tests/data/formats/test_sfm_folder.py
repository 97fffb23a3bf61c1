"""COLMAP's and nerfstudio's folders with a file of hands: the same clip either way, and what is refused."""

from __future__ import annotations

import contextlib
import json
import os
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.data.formats.colmap_files import check_model_files
from bigs.data.formats.layouts import layout_of, load_clip
from bigs.data.formats.sfm_folder import load_sfm_folder
from bigs.data.formats.writers import write_colmap, write_nerfstudio
from bigs.data.moving import move_hand, move_object
from bigs.hand import HandModel
from bigs.train.start.initial import initial_trajectory
from bigs.types import Side

WRITERS: dict[str, Callable[[Path, Clip], Path]] = {"colmap": write_colmap, "nerfstudio": write_nerfstudio}
NO_MEAN = np.zeros((15, 3))


@pytest.fixture(scope="module")
def in_camera(tiny: Clip, both_hands: dict[Side, HandModel]) -> Clip:
    """The tiny clip with the camera as its world."""
    motions = tiny.cam_from_world
    hands = {}
    for side, track in tiny.hands.items():
        betas = torch.as_tensor(track.betas, dtype=torch.float32)
        hands[side] = move_hand(track, motions, both_hands[side].rest_joints(betas)[0].double().numpy())
    assert tiny.object is not None
    return replace(
        tiny,
        hands=hands,
        object=move_object(tiny.object, motions),
        cam_from_world=np.repeat(np.eye(4)[None], len(tiny), axis=0),
    )


@pytest.mark.parametrize("kind", WRITERS)
def test_the_clip_is_the_same(
    kind: str, tmp_path: Path, in_camera: Clip, tiny: Clip, both_hands: dict[Side, HandModel]
) -> None:
    folder = WRITERS[kind](tmp_path / "clip", in_camera)
    assert layout_of(folder) == "sfm"
    clip = load_clip(folder, NO_MEAN)
    assert not clip.annotated and (clip.name, len(clip)) == ("clip", len(tiny))
    np.testing.assert_allclose(clip.K, tiny.K, atol=1e-9)
    expected, found = initial_trajectory(tiny, both_hands), initial_trajectory(clip, both_hands)
    for side in ("right", "left"):
        np.testing.assert_allclose(found.verts[side], expected.verts[side], atol=2e-6)
    assert found.object_verts is not None and expected.object_verts is not None
    # COLMAP gives points in an order of its own.
    for t in (0, 7):
        distances = np.linalg.norm(found.object_verts[t][:, None] - expected.object_verts[t][None], axis=2)
        assert distances.min(axis=0).max() < 2e-6 and distances.min(axis=1).max() < 2e-6
        if kind == "nerfstudio":
            np.testing.assert_allclose(found.object_verts[t], expected.object_verts[t], atol=2e-6)
    assert clip.object is not None and tiny.object is not None and clip.object.colors is not None
    np.testing.assert_allclose(clip.object.colors.mean(axis=0), tiny.object.colors.mean(axis=0), atol=1e-6)
    for t in (0, 11):
        np.testing.assert_array_equal(clip.image(t), tiny.image(t))
        np.testing.assert_array_equal(clip.mask(t), tiny.mask(t))


def test_frames_are_decoded_once(tmp_path: Path, in_camera: Clip, reads: Counter[str]) -> None:
    folder = write_nerfstudio(tmp_path / "clip", in_camera)
    reads.clear()
    clip = load_sfm_folder(folder)
    for t in range(len(clip)):
        clip.image(t)
        clip.mask(t)
    assert set(reads.values()) == {1} and len(reads) == 2 * len(clip)


def test_numbers_that_are_left_out_tell_the_rate(tmp_path: Path, in_camera: Clip) -> None:
    assert load_sfm_folder(write_nerfstudio(tmp_path / "clip", in_camera)).fps == 30.0
    for kind in ("images", "masks"):
        for file in sorted((tmp_path / "clip" / kind).iterdir(), reverse=True):
            file.rename(file.with_stem(f"{3 * int(file.stem):04d}"))
    document = (tmp_path / "clip" / "transforms.json").read_text()
    for t in range(len(in_camera) - 1, -1, -1):
        document = document.replace(f"images/{t:04d}.png", f"images/{3 * t:04d}.png")
    (tmp_path / "clip" / "transforms.json").write_text(document)
    assert load_sfm_folder(tmp_path / "clip").fps == 10.0


def test_colmap_itself_reads_the_model(tmp_path: Path, in_camera: Clip) -> None:
    """Points fall where COLMAP's own projection puts them; a binary model is the same clip."""
    folder = write_colmap(tmp_path / "clip", in_camera)
    place = folder / "sparse" / "0"
    model = pycolmap.Reconstruction(str(place))
    clip = load_sfm_folder(folder)
    image = next(i for i in model.images.values() if Path(i.name).stem == clip.image_paths[5].stem)
    point = next(iter(model.points3D.values())).xyz
    index = int(np.argmin(np.linalg.norm(clip.object.points - point, axis=1)))
    ours = clip.object.points_world()[5, index] @ clip.K.T
    np.testing.assert_allclose(image.project_point(point), ours[:2] / ours[2], atol=1e-6)
    for file in place.iterdir():
        file.unlink()
    model.write_binary(str(place))
    assert {file.suffix for file in place.iterdir()} == {".bin"}
    again = load_sfm_folder(folder)
    np.testing.assert_allclose(again.object.transl, clip.object.transl, atol=1e-12)


def test_without_a_scale_the_object_is_where_the_hands_are(tmp_path: Path, in_camera: Clip) -> None:
    folder = write_nerfstudio(tmp_path / "clip", in_camera)
    given = load_sfm_folder(folder)
    with np.load(folder / "hands.npz") as stored:
        arrays = {key: stored[key] for key in stored.files if key != "object_scale"}
    np.savez(folder / "hands.npz", **arrays)
    found = load_sfm_folder(folder)
    assert given.object is not None and found.object is not None
    assert found.object.scale == pytest.approx(given.object.scale, rel=0.25)
    # Size and distance change together, so every point stays on its ray.
    ratio = found.object.scale / given.object.scale
    np.testing.assert_allclose(found.object.points_world(), ratio * given.object.points_world(), atol=1e-9)


def test_missing_frames_are_filled(tmp_path: Path, in_camera: Clip) -> None:
    folder = write_nerfstudio(tmp_path / "clip", in_camera)
    file = folder / "transforms.json"
    document = json.loads(file.read_text())
    del document["frames"][4]
    file.write_text(json.dumps(document))
    with np.load(folder / "hands.npz") as stored:
        arrays = {key: stored[key].copy() for key in stored.files}
    arrays["left_transl"][2] = np.nan
    arrays["left_valid"][2] = False
    np.savez(folder / "hands.npz", **arrays)
    clip = load_sfm_folder(folder)
    assert clip.object is not None and in_camera.object is not None
    np.testing.assert_array_equal(np.flatnonzero(~clip.object.valid), [4])
    np.testing.assert_array_equal(np.flatnonzero(~clip.hands["left"].valid), [2])
    track = clip.hands["left"].transl
    np.testing.assert_allclose(track[2], (track[1] + track[3]) / 2)
    turn = clip.object.rotations[4].T @ in_camera.object.rotations[4]
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 10


def edit(file: Path, **changes: object) -> None:
    with np.load(file) as stored:
        arrays = {key: stored[key] for key in stored.files}
    np.savez(file, **(arrays | changes))  # type: ignore[arg-type]


def edit_frames(folder: Path, **changes: object) -> None:
    document = json.loads((folder / "transforms.json").read_text())
    document["frames"][3] |= changes
    (folder / "transforms.json").write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("kind", "damage", "words"),
    [
        (
            "colmap",
            lambda f: (f / "hands.npz").unlink(),
            "hands.npz: expected estimates of the hands, found no",
        ),
        (
            "colmap",
            lambda f: edit(f / "hands.npz", right_betas=np.zeros(9)),
            r"right_betas: expected shape \[10\]",
        ),
        (
            "colmap",
            lambda f: edit(f / "hands.npz", right_transl=np.full((12, 3), np.nan)),
            "right_valid: expected valid frames with finite poses, found one that is not in frame 0",
        ),
        (
            "colmap",
            lambda f: edit(f / "hands.npz", object_scale=-1.0),
            "object_scale: expected a positive number",
        ),
        ("colmap", lambda f: next((f / "masks").iterdir()).unlink(), "masks: expected a mask for each of 12"),
        ("colmap", lambda f: (f / "sparse/0/images.txt").write_text("1 x\n"), "sparse/0: expected"),
        (
            "colmap",
            lambda f: (f / "sparse/0/cameras.txt").write_text("1 SIMPLE_RADIAL 120 90 100 60 45 0.1\n"),
            "expected a camera without distortion, found SIMPLE_RADIAL",
        ),
        (
            "colmap",
            lambda f: (f / "sparse/0/cameras.txt").write_text("1 SIMPLE_PINHOLE 100 90 100 60 45\n"),
            "expected a camera of 120 x 90, found 100 x 90",
        ),
        (
            "nerfstudio",
            lambda f: edit_frames(f, k1=0.2),
            r"frames\[3\].k1: expected a camera without distortion",
        ),
        ("nerfstudio", lambda f: edit_frames(f, fl_x=90.0), r"frames\[3\]: expected the first frame's lens"),
        (
            "nerfstudio",
            lambda f: (f / "sparse_pc.ply").unlink(),
            "sparse_pc.ply: expected the model's points",
        ),
        (
            "nerfstudio",
            lambda f: (f / "sparse_pc.ply").write_bytes(b"x"),
            "sparse_pc.ply: expected the model's points, found",
        ),
    ],
)
def test_what_is_wrong(
    kind: str, damage: Callable[[Path], None], words: str, tmp_path: Path, in_camera: Clip
) -> None:
    folder = WRITERS[kind](tmp_path / "clip", in_camera)
    damage(folder)
    with pytest.raises(InputError, match=words):
        load_clip(folder, NO_MEAN)


def test_a_model_of_other_images_is_refused(tmp_path: Path, in_camera: Clip) -> None:
    folder = write_nerfstudio(tmp_path / "clip", in_camera)
    for part in ("images", "masks"):
        for file in sorted((folder / part).iterdir()):
            Image.open(file).save(file.with_name(f"other_{file.name}"))
            file.unlink()
    with pytest.raises(InputError, match="found none of them in it"):
        load_clip(folder, NO_MEAN)


@pytest.fixture
def binary(tmp_path: Path, in_camera: Clip) -> Path:
    """The model of a clip, in binary."""
    place = write_colmap(tmp_path / "clip", in_camera) / "sparse" / "0"
    model = pycolmap.Reconstruction(str(place))
    for file in place.iterdir():
        file.unlink()
    model.write_binary(str(place))
    return place


def test_a_binary_model_that_is_cut_is_told(binary: Path) -> None:
    check_model_files(binary)
    for name in ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"):
        file = binary / name
        content = file.read_bytes()
        for keep in (0, 5, min(30, len(content) - 3), len(content) // 2, len(content) - 1):
            file.write_bytes(content[:keep])
            with pytest.raises(InputError, match=f"{name}: "):
                load_sfm_folder(binary.parent.parent)
        # A count that no memory holds, and more than is announced.
        for wrong in (b"\xff" * 8 + content[8:], content + b"\0"):
            file.write_bytes(wrong)
            with pytest.raises(InputError, match=f"{name}: "):
                load_sfm_folder(binary.parent.parent)
        file.write_bytes(content)


@pytest.mark.parametrize("focal", [0.0, -100.0, float("nan"), float("inf"), 1e-9])
def test_a_camera_without_a_focal_length(binary: Path, focal: float) -> None:
    file = binary / "cameras.bin"
    content = bytearray(file.read_bytes())
    struct.pack_into("<d", content, 8 + 24, focal)
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"camera"):
        load_sfm_folder(binary.parent.parent)


@pytest.mark.parametrize("name", ["rigs.bin", "frames.bin"])
def test_counts_that_a_reader_would_follow_for_hours(binary: Path, name: str) -> None:
    content = (binary / name).read_bytes()
    for place in range(8, len(content) - 4):
        (binary / name).write_bytes(content[:place] + b"\xff\xff\xff\x7f" + content[place + 4 :])
        with contextlib.suppress(InputError):
            check_model_files(binary)
    (binary / name).write_bytes(struct.pack("<Q", 2**60) + content[8:])
    with pytest.raises(InputError, match=f"{name}: expected a whole file"):
        check_model_files(binary)


@pytest.mark.parametrize("name", ["rigs.bin", "frames.bin", "rigs.txt", "cameras.bin"])
def test_a_pipe_in_a_model(binary: Path, name: str) -> None:
    (binary / name).unlink(missing_ok=True)
    (binary / name).with_suffix(".bin").unlink(missing_ok=True)
    os.mkfifo(binary / name)
    with pytest.raises(InputError, match=rf"{name}: expected a.* COLMAP model, found a pipe"):
        check_model_files(binary)


def test_a_rig_of_several_cameras(binary: Path) -> None:
    """Two sensors, of which the second has a pose, as COLMAP writes them."""
    second = struct.pack("<iIB7d", 0, 2, 1, 1, 0, 0, 0, 0, 0, 0)
    third = struct.pack("<iIB", 0, 3, 0)
    (binary / "rigs.bin").write_bytes(struct.pack("<QIIiI", 1, 1, 3, 0, 1) + second + third)
    check_model_files(binary)

"""Challenge predictions: every key by its own formula, the round trip, and poisoned input."""

import dataclasses
import os
import pickle
import sys
import types

import numpy as np
import pytest
import torch

from bigs.checks import InputError
from bigs.export.challenge import load_challenge, validate_challenge, write_challenge
from bigs.types import HandObjectTrajectory

SHIFT = (0.1, -0.2, -0.6)


@pytest.fixture
def trajectory():
    rng = np.random.default_rng(0)
    return HandObjectTrajectory(
        name="arctic_s99_box_grab_01_1",
        frame_names=("00100.jpg", "00101.jpg", "00102.jpg"),
        joints={side: 0.1 * rng.normal(size=(3, 21, 3)) + [0, 0, 0.7] for side in ("right", "left")},
        verts={side: 0.1 * rng.normal(size=(3, 30, 3)) + [0, 0, 0.7] for side in ("right", "left")},
        faces={side: rng.integers(0, 30, size=(50, 3)) for side in ("right", "left")},
        object_verts=0.1 * rng.normal(size=(3, 40, 3)) + [0, 0, 0.7],
        object_faces=rng.integers(0, 40, size=(60, 3)),
    )


@pytest.fixture
def v_posed():
    return 0.1 * np.random.default_rng(1).normal(size=(30, 3))


@pytest.fixture
def written(tmp_path, trajectory, v_posed):
    path = tmp_path / "clip.pt"
    write_challenge(path, trajectory, SHIFT, v_posed_left=v_posed)
    return path


def test_every_key_has_its_documented_content(written, trajectory, v_posed):
    content = torch.load(written, weights_only=True)
    assert type(content) is dict
    assert content.pop("full_seq_name") == trajectory.name
    folder = f"./data/{trajectory.name}/build/image"
    assert content.pop("fnames") == [f"{folder}/0000.png", f"{folder}/0001.png", f"{folder}/0002.png"]
    faces = content.pop("faces")
    assert {key: value.dtype for key, value in faces.items()} == dict.fromkeys(
        ("right", "left", "object"), torch.int16
    )
    assert np.array_equal(faces["object"], trajectory.object_faces)

    j, v, o = trajectory.joints, trajectory.verts, trajectory.object_verts
    centre = (o.min(axis=1) + o.max(axis=1)) / 2
    n = np.array(SHIFT)
    expected = {
        "j3d_c.right": j["right"],
        "j3d_c.left": j["left"],
        "j3d_ra.right": j["right"] - j["right"][:, [0]],
        "j3d_ra.left": j["left"] - j["left"][:, [0]],
        "root.right": j["right"][:, 0],
        "root.left": j["left"][:, 0],
        "root.object": centre,
        "v3d_c.right": v["right"],
        "v3d_c.left": v["left"],
        "v3d_c.object": o,
        "v3d_ra.object": o - centre[:, None],
        "v3d_right.object": o - j["right"][:, [0]],
        "v3d_left.object": o - j["left"][:, [0]],
        "verts.right": 2 / np.linalg.norm(n) * (v["right"] @ np.diag([1, -1, -1]) + n),
        "verts.object": 2 / np.linalg.norm(n) * (o @ np.diag([1, -1, -1]) + n),
        "v_posed.left": np.broadcast_to(v_posed, (3, 30, 3)),
    }
    assert set(content) == set(expected)
    for key, values in expected.items():
        assert content[key].dtype == torch.float16, key
        assert np.array_equal(content[key].numpy(), values.astype(np.float16)), key


def test_hold_evaluates_the_scaled_space_to_the_camera(written, trajectory):
    """HOLD's own way back, F(w / s - n), gives the camera-space vertices."""
    content = torch.load(written, weights_only=True)
    s, n = 2 / np.linalg.norm(SHIFT), np.array(SHIFT)
    back = (content["verts.object"].double().numpy() / s - n) * [1, -1, -1]
    assert np.abs(back - trajectory.object_verts).max() < 1e-3


def test_a_scene_scale_of_the_clips_own_is_used(tmp_path, trajectory, v_posed):
    for name, scale in (("a.pt", 1.0), ("b.pt", 2.0)):
        write_challenge(tmp_path / name, trajectory, SHIFT, v_posed_left=v_posed, scene_scale=scale)
    a, b = (torch.load(tmp_path / name, weights_only=True)["verts.right"] for name in ("a.pt", "b.pt"))
    assert torch.equal(2 * a, b)


def test_round_trip(written, trajectory):
    validate_challenge(written)
    read = load_challenge(written, trajectory.frame_names)
    assert (read.name, read.frame_names) == (trajectory.name, trajectory.frame_names)
    assert load_challenge(written).frame_names == ("0000.png", "0001.png", "0002.png")
    for side in ("right", "left"):
        assert np.abs(read.joints[side] - trajectory.joints[side]).max() < 5e-4
        assert np.abs(read.verts[side] - trajectory.verts[side]).max() < 5e-4
        assert np.array_equal(read.faces[side], trajectory.faces[side])
    assert np.abs(read.object_verts - trajectory.object_verts).max() < 5e-4
    assert np.array_equal(read.object_faces, trajectory.object_faces)


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_missing_hand_has_no_keys(tmp_path, trajectory, v_posed, side):
    alone = dataclasses.replace(
        trajectory,
        joints={side: trajectory.joints[side]},
        verts={side: trajectory.verts[side]},
        faces={side: trajectory.faces[side]},
    )
    path = tmp_path / "clip.pt"
    write_challenge(path, alone, SHIFT, v_posed_left=v_posed if side == "left" else None)
    validate_challenge(path)
    content = torch.load(path, weights_only=True)
    other = "left" if side == "right" else "right"
    assert not any(other in key for key in content)
    assert f"v3d_{side}.object" in content
    assert set(content["faces"]) == {side, "object"}
    assert set(load_challenge(path).joints) == {side}


def test_a_clip_without_object_is_legal(tmp_path, trajectory, v_posed):
    hands = dataclasses.replace(trajectory, object_verts=None, object_faces=None)
    write_challenge(tmp_path / "clip.pt", hands, SHIFT, v_posed_left=v_posed)
    validate_challenge(tmp_path / "clip.pt")
    assert load_challenge(tmp_path / "clip.pt").object_verts is None


def test_faces_of_a_large_mesh_are_int32(tmp_path, trajectory, v_posed):
    verts = np.random.default_rng(0).normal(size=(3, 40_000, 3))
    large = dataclasses.replace(trajectory, object_verts=verts, object_faces=np.array([[0, 1, 39_999]]))
    write_challenge(tmp_path / "clip.pt", large, SHIFT, v_posed_left=v_posed)
    stored = torch.load(tmp_path / "clip.pt", weights_only=True)["faces"]
    assert stored["object"].dtype == torch.int32
    assert stored["right"].dtype == torch.int16
    assert load_challenge(tmp_path / "clip.pt").object_faces.tolist() == [[0, 1, 39_999]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda c: {"joints": {**c.joints, "left": np.full_like(c.joints["left"], np.nan)}},
            r"j3d_c\.left: expected finite values, found nan at index \[0, 0, 0\]",
        ),
        (
            lambda c: {"object_verts": c.object_verts + 1e6},
            r"root\.object as float16: expected finite values, found inf",
        ),
        (
            lambda c: {"object_verts": c.object_verts[:2]},
            r"v3d_c\.object: expected shape \[3, V, 3\], found \[2, 40, 3\]",
        ),
        (
            lambda c: {"joints": {**c.joints, "left": c.joints["left"][:, :16]}},
            r"expected shape \[3, 21, 3\]",
        ),
        (lambda c: {"object_faces": None}, r"faces\.object: expected the faces of a mesh"),
        (lambda c: {"object_faces": c.object_faces + 40}, r"faces\.object: expected indices below 40"),
        (lambda c: {"verts": {"right": c.verts["right"]}}, r"v3d_c\.left: expected the vertices"),
        (lambda c: {"joints": {}, "object_verts": None}, "expected at least one of"),
    ],
)
def test_poisoned_trajectories_are_named_and_leave_no_file(tmp_path, trajectory, v_posed, change, message):
    with pytest.raises(InputError, match=message):
        write_challenge(
            tmp_path / "clip.pt",
            dataclasses.replace(trajectory, **change(trajectory)),
            SHIFT,
            v_posed_left=v_posed,
        )
    assert list(tmp_path.iterdir()) == []


def test_bad_arguments_are_named(tmp_path, trajectory, v_posed):
    path = tmp_path / "clip.pt"
    with pytest.raises(InputError, match="v_posed_left: expected vertices"):
        write_challenge(path, trajectory, SHIFT)
    with pytest.raises(InputError, match=r"v_posed_left: expected shape \[30, 3\], found \[29, 3\]"):
        write_challenge(path, trajectory, SHIFT, v_posed_left=v_posed[1:])
    with pytest.raises(InputError, match="normalize_shift: expected a shift other than zero"):
        write_challenge(path, trajectory, (0, 0, 0), v_posed_left=v_posed)
    assert list(tmp_path.iterdir()) == []


def rewrite(path, change):
    content = torch.load(path, weights_only=True)
    change(content)
    torch.save(content, path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("fnames"), "fnames: expected a list, found None"),
        (lambda c: c.update(fnames=[1, 2, 3]), "fnames: expected a path"),
        (lambda c: c.update({"j3d_c.left": [1]}), r"j3d_c\.left: expected a tensor, found list"),
        (lambda c: c["v3d_c.right"].fill_(torch.inf), r"v3d_c\.right: expected finite values"),
        (lambda c: c.update(faces=torch.zeros(3)), "faces: expected a dictionary, found Tensor"),
        (
            lambda c: c["faces"].update(left=torch.full((1, 3), 99)),
            r"faces\.left: expected indices from 0 to 29",
        ),
        (lambda c: c["j3d_ra.right"].add_(0.1), r"j3d_ra\.right: expected j3d_c\.right minus root\.right"),
        (lambda c: c["root.object"].add_(0.1), r"v3d_ra\.object: expected v3d_c\.object minus root\.object"),
    ],
)
def test_wrong_files_are_named(written, change, message):
    rewrite(written, change)
    with pytest.raises(InputError, match=message):
        load_challenge(written)


def test_validation_wants_every_key(written):
    rewrite(written, lambda content: content.pop("v_posed.left"))
    load_challenge(written)
    with pytest.raises(InputError, match=r"expected a field v_posed\.left, found none"):
        validate_challenge(written)


def test_nested_dictionaries_are_read(written, trajectory):
    nested = {}
    for key, value in torch.load(written, weights_only=True).items():
        group, _, entity = key.partition(".")
        if entity:
            nested.setdefault(group, {})[entity] = value
        else:
            nested[key] = value
    torch.save(nested, written)
    assert np.abs(load_challenge(written).joints["left"] - trajectory.joints["left"]).max() < 5e-4


def test_holds_own_dictionary_class_is_read(written, trajectory, monkeypatch):
    class Xdict(dict):
        __module__, __qualname__ = "common.xdict", "xdict"

    module = types.ModuleType("common.xdict")
    module.xdict = Xdict
    monkeypatch.setitem(sys.modules, "common", types.ModuleType("common"))
    monkeypatch.setitem(sys.modules, "common.xdict", module)
    torch.save(Xdict(torch.load(written, weights_only=True)), written)
    with pytest.raises(pickle.UnpicklingError):
        torch.load(written, weights_only=True)
    assert load_challenge(written).name == trajectory.name


class _Harmful:
    def __reduce__(self):
        return (os.mkdir, ("harm",))


def test_a_file_that_tries_to_run_code_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"fnames": [_Harmful()]}, tmp_path / "clip.pt")
    with pytest.raises(InputError, match="cannot be read safely"):
        load_challenge(tmp_path / "clip.pt")
    assert not (tmp_path / "harm").exists()


def test_damaged_and_missing_files_are_named(tmp_path, written):
    written.write_bytes(written.read_bytes()[:200])
    with pytest.raises(InputError, match=r"clip\.pt: expected"):
        load_challenge(written)
    with pytest.raises(InputError, match="found no such file"):
        load_challenge(tmp_path / "gone.pt")
    torch.save([1, 2], written)
    with pytest.raises(InputError, match="expected a dictionary, found list"):
        load_challenge(written)


def test_the_wrong_number_of_names_is_named(written):
    with pytest.raises(InputError, match="expected 2 frames, found 3"):
        load_challenge(written, ("a", "b"))


@pytest.mark.parametrize("depth", [8, 200])
def test_dictionaries_in_dictionaries_are_bounded(tmp_path, depth):
    nested: dict = {"x": torch.zeros(1)}
    for _ in range(depth):
        nested = {"a": nested}
    torch.save(nested, tmp_path / "deep.pt")
    with pytest.raises(InputError, match=r"deep\.pt"):
        load_challenge(tmp_path / "deep.pt")
    torch.save({1: torch.zeros(1)}, tmp_path / "deep.pt")
    with pytest.raises(InputError, match=r"deep\.pt: expected texts as keys, found 1"):
        load_challenge(tmp_path / "deep.pt")

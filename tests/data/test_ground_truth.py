"""`gt.npz` and `gt_object.ply`: round trip, one-hand clips, and what is wrong with a wrong file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from bigs.checks import InputError
from bigs.data.ground_truth import load_ground_truth, write_ground_truth

FRAMES = 3
MESH = trimesh.creation.box(extents=(0.1, 0.2, 0.3))
QUARTER_TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def truth_arrays() -> dict[str, Any]:
    rng = np.random.default_rng(0)
    arrays: dict[str, Any] = {
        "obj_R": np.repeat(QUARTER_TURN[None], FRAMES, axis=0),
        "obj_t": rng.normal(size=(FRAMES, 3)),
        "obj_scale": 2.0,
    }
    for side in ("right", "left"):
        arrays[f"{side}_verts"] = 0.04 * rng.normal(size=(FRAMES, 7, 3))
        arrays[f"{side}_joints"] = 0.04 * rng.normal(size=(FRAMES, 21, 3))
        arrays[f"{side}_faces"] = rng.integers(0, 7, (9, 3))
    return arrays


def test_round_trip(tmp_path: Path) -> None:
    arrays = truth_arrays()
    file = write_ground_truth(tmp_path / "clip", arrays=arrays, object_mesh=MESH)
    for path in (file, file.parent):
        truth = load_ground_truth(path)
        assert truth.name == "clip" and truth.frame_names == ("0000", "0001", "0002")
        for side in ("right", "left"):
            np.testing.assert_array_equal(truth.verts[side], arrays[f"{side}_verts"])
            np.testing.assert_array_equal(truth.joints[side], arrays[f"{side}_joints"])
            np.testing.assert_array_equal(truth.faces[side], arrays[f"{side}_faces"])
        assert truth.object_verts is not None
        expected = np.array([[-2 * y, 2 * x, 2 * z] for x, y, z in MESH.vertices]) + arrays["obj_t"][1]
        np.testing.assert_allclose(truth.object_verts[1], expected, atol=1e-6)
        np.testing.assert_array_equal(truth.object_faces, MESH.faces)


def test_one_hand_and_no_object(tmp_path: Path) -> None:
    arrays = {key: value for key, value in truth_arrays().items() if key.startswith("left")}
    truth = load_ground_truth(write_ground_truth(tmp_path, arrays=arrays, object_mesh=None))
    assert set(truth.verts) == {"left"} and truth.object_verts is None and truth.object_faces is None


def test_frames_are_named_by_the_clip(tmp_path: Path) -> None:
    file = write_ground_truth(tmp_path, arrays=truth_arrays(), object_mesh=MESH)
    (tmp_path / "build").mkdir()
    (tmp_path / "build" / "corres.txt").write_text("a.jpg\nb.jpg\nc.jpg\n")
    assert load_ground_truth(file).frame_names == ("a.jpg", "b.jpg", "c.jpg")
    (tmp_path / "build" / "corres.txt").write_text("a.jpg\nb.jpg\n")
    with pytest.raises(InputError, match=r"corres\.txt.*found 3"):
        load_ground_truth(file)


def without(key: str) -> dict[str, Any]:
    return {name: value for name, value in truth_arrays().items() if name != key}


def broken(key: str, value: Any) -> dict[str, Any]:
    return truth_arrays() | {key: value}


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        (without("left_joints"), "left_joints"),
        (without("obj_t"), "obj_t"),
        (broken("right_joints", np.zeros((FRAMES, 16, 3))), r"right_joints.*21.*16"),
        (broken("left_verts", np.zeros((FRAMES + 1, 7, 3))), r"left_verts.*\[3, V, 3\]"),
        (broken("right_verts", np.full((FRAMES, 7, 3), np.nan)), r"right_verts.*nan"),
        (broken("right_verts", np.zeros(())), r"right_verts.*\[T, V, 3\]"),
        (broken("right_verts", np.zeros((0, 7, 3))), "right_verts.*at least one frame"),
        (broken("right_verts", np.zeros((FRAMES, 7, 3))), r"right_verts.*a hand of .* found one of 0 m"),
        (broken("left_joints", np.full((FRAMES, 21, 3), 0.5)), r"left_joints.*a hand of .* found one of 0 m"),
        (broken("left_joints", 100 * truth_arrays()["left_joints"]), "left_joints.*a hand of"),
        (broken("right_faces", np.full((9, 3), 7)), r"right_faces.*0 to 6, found 7"),
        (broken("right_faces", np.full((9, 3), 0.5)), r"right_faces.*whole numbers"),
        (broken("right_faces", np.full((9, 3), -1)), r"right_faces.*0 to 6, found -1"),
        (broken("obj_R", np.zeros((FRAMES, 3, 3))), r"obj_R.*rotation.*index \[0\]"),
        (broken("obj_R", -np.repeat(np.eye(3)[None], FRAMES, axis=0)), r"obj_R.*determinant"),
        (broken("obj_R", 2 * np.repeat(np.eye(3)[None], FRAMES, axis=0)), r"obj_R.*rotation"),
        (broken("obj_scale", 0.0), "obj_scale.*positive"),
        (broken("obj_scale", -2.0), "obj_scale.*positive.*-2"),
        (broken("obj_scale", np.nan), "obj_scale.*nan"),
        (broken("obj_scale", np.ones(2)), "obj_scale.*one number"),
        (broken("obj_R", np.zeros((FRAMES, 9))), "obj_R"),
        ({"K": np.eye(3)}, "right_verts, left_verts or obj_R"),
    ],
)
def test_wrong_fields(tmp_path: Path, arrays: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=rf"gt\.npz: .*{words}"):
        load_ground_truth(write_ground_truth(tmp_path, arrays=arrays, object_mesh=MESH))


def test_missing_and_damaged_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gt\.npz.*found no such file"):
        load_ground_truth(tmp_path)
    file = write_ground_truth(tmp_path, arrays=truth_arrays(), object_mesh=None)
    with pytest.raises(InputError, match=r"gt_object\.ply.*found no such file"):
        load_ground_truth(file)
    (tmp_path / "gt_object.ply").write_text("ply\nnonsense")
    with pytest.raises(InputError, match=r"gt_object\.ply.*triangle mesh"):
        load_ground_truth(file)
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(InputError, match=r"gt\.npz.*plain arrays"):
        load_ground_truth(file)


def test_pickled_arrays_are_refused(tmp_path: Path) -> None:
    arrays = broken("left_verts", np.array([{}, {}, {}], dtype=object))
    with pytest.raises(InputError, match=r"gt\.npz.*plain arrays"):
        load_ground_truth(write_ground_truth(tmp_path, arrays=arrays, object_mesh=MESH))


def test_shared_clips(shared_clip: Path) -> None:
    truth = load_ground_truth(shared_clip)
    stored = np.load(shared_clip / "gt.npz")
    assert truth.frame_names[0] == "00100.jpg" and len(truth.frame_names) == len(stored["obj_R"])
    assert truth.object_verts is not None
    # The true grasp: some vertex of each touching hand is within 3 mm of the object.
    t = int(np.flatnonzero(stored["right_contact"])[0])
    mesh = trimesh.Trimesh(truth.object_verts[t], truth.object_faces, process=False)
    _, distance, _ = trimesh.proximity.closest_point(mesh, truth.verts["right"][t][::3])
    assert distance.min() < 0.006


def spread(verts: list[list[float]], faces: list[list[int]]) -> trimesh.Trimesh:
    return trimesh.Trimesh(verts, faces, process=False)


CORNERS = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]]


@pytest.mark.parametrize(
    ("mesh", "words"),
    [
        (spread([*CORNERS[:2], [0.0, np.nan, 0.0]], [[0, 1, 2]]), "nan at index"),
        (spread(CORNERS[:3], [[0, 1, 2]]), "surface of a solid"),
        (spread(CORNERS, [[0, 1, 2]]), "surface of a solid"),
        (spread(CORNERS, [[0, 0, 0], [1, 1, 1], [2, 2, 2], [3, 3, 3]]), "surface of a solid"),
        (trimesh.creation.box(extents=(1e-9, 1e-9, 1e-9)), "surface of 0.002 to 2 m"),
        (trimesh.creation.box(extents=(50.0, 50.0, 50.0)), "surface of 0.002 to 2 m"),
    ],
)
def test_an_object_without_shape(tmp_path: Path, mesh: trimesh.Trimesh, words: str) -> None:
    with pytest.raises(InputError, match=rf"gt_object\.ply.*{words}"):
        load_ground_truth(write_ground_truth(tmp_path, arrays=truth_arrays(), object_mesh=mesh))


def test_a_mesh_whose_faces_name_no_vertex(tmp_path: Path) -> None:
    file = write_ground_truth(tmp_path, arrays=truth_arrays(), object_mesh=None)
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    verts = "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS)
    (tmp_path / "gt_object.ply").write_text(f"{head}{verts}3 0 1 9\n")
    with pytest.raises(InputError, match=r"gt_object\.ply"):
        load_ground_truth(file)


def test_one_vertex_that_is_no_number_is_named(tmp_path: Path) -> None:
    mesh = trimesh.creation.icosphere(radius=0.05)
    mesh.vertices[17, 2] = np.nan
    file = write_ground_truth(tmp_path, arrays=truth_arrays(), object_mesh=mesh)
    with pytest.raises(InputError, match=r"gt_object\.ply: vertices: .*nan at index \[17, 2\]"):
        load_ground_truth(file)

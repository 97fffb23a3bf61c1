"""Meshes come back as they were given, in every format."""

import numpy as np
import pytest
import trimesh

from bigs.checks import InputError
from bigs.export.mesh import MESH_FORMATS, save_mesh


@pytest.fixture
def box():
    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


@pytest.mark.parametrize("suffix", MESH_FORMATS)
def test_round_trip(tmp_path, box, suffix):
    verts, faces = box
    colors = np.random.default_rng(0).random((len(verts), 3))
    path = tmp_path / f"object.{suffix}"
    save_mesh(path, verts, faces, colors)
    read = trimesh.load(path, process=False, force="mesh")
    assert np.allclose(read.vertices, verts, atol=1e-6)
    assert np.array_equal(read.faces, faces)
    assert np.abs(read.visual.vertex_colors[:, :3] - 255 * colors).max() <= 1.0
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_colors_may_be_left_out(tmp_path, box):
    save_mesh(tmp_path / "a.ply", *box)
    assert trimesh.load(tmp_path / "a.ply").is_watertight


def test_bad_meshes_are_named_and_nothing_is_written(tmp_path, box):
    verts, faces = box
    with pytest.raises(InputError, match="suffix: expected one of ply, obj, glb, found 'stl'"):
        save_mesh(tmp_path / "a.stl", verts, faces)
    with pytest.raises(InputError, match="faces: expected indices from 0 to 7, found 1 to 8"):
        save_mesh(tmp_path / "a.ply", verts, faces + 1)
    with pytest.raises(InputError, match="vertices: expected finite values"):
        save_mesh(tmp_path / "a.ply", verts * np.nan, faces)
    with pytest.raises(InputError, match=r"colors: expected shape \[8, 3\]"):
        save_mesh(tmp_path / "a.ply", verts, faces, np.zeros((7, 3)))
    assert list(tmp_path.iterdir()) == []

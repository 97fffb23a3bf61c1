"""Meshes that somebody else made: read as they are, bounded, and nothing beside them that is no file."""

from __future__ import annotations

import io
import json
import os
import struct
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from bigs.checks import InputError
from bigs.commands.prior.train import read_shape
from bigs.data.meshes import read_mesh

MIB = 1 << 20
BOX = trimesh.creation.box((0.1, 0.2, 0.3))
VERTS, FACES = np.asarray(BOX.vertices), np.asarray(BOX.faces)
POINTS = "".join(f"v {x} {y} {z}\n" for x, y, z in VERTS)
TRIANGLES = "".join(f"f {a} {b} {c}\n" for a, b, c in FACES + 1)


def ply(header: str, body: bytes = b"") -> bytes:
    return f"ply\nformat {header}\nend_header\n".encode() + body


def glb(document: dict[str, object], binary: bytes = b"") -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<II", len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(binary), 0x004E4942)
        + binary
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".off", ".glb"])
def test_every_kind_is_read(tmp_path: Path, suffix: str) -> None:
    BOX.export(tmp_path / f"box{suffix}")
    verts, faces = read_mesh(tmp_path / f"box{suffix}")
    corners, expected = verts[faces].reshape(-1, 3), VERTS[FACES].reshape(-1, 3)
    if suffix == ".stl":
        assert len(faces) == len(FACES)
    np.testing.assert_allclose(np.sort(corners, axis=0), np.sort(expected, axis=0), atol=1e-6)


def test_an_obj_keeps_its_vertices(tmp_path: Path) -> None:
    """Materials, groups, texture coordinates and normals are of no concern to a shape."""
    face = "".join(
        f"usemtl m{i}\ng part{i}\nf {a}/{i % 3 + 1}/1 {b}/{i % 2 + 1}/1 \\\n{c}/1/1\n"
        for i, (a, b, c) in enumerate(FACES + 1)
    )
    text = "mtllib none.mtl\n" + POINTS + "vt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\n" + face
    (tmp_path / "box.obj").write_text(text)
    verts, faces = read_mesh(tmp_path / "box.obj")
    np.testing.assert_array_equal(verts, VERTS)
    np.testing.assert_array_equal(faces, FACES)


def test_a_texture_colours_a_shape(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4), (255, 0, 0)).save(tmp_path / "red.png")
    (tmp_path / "box.mtl").write_text("newmtl m\nmap_Kd red.png\n")
    faces = "".join(f"f {a}/1 {b}/2 {c}/3\n" for a, b, c in FACES + 1)
    text = f"mtllib box.mtl\n{POINTS}vt 0 0\nvt 1 0\nvt 0 1\nusemtl m\n{faces}"
    (tmp_path / "box.obj").write_text(text)
    colors = read_shape(tmp_path / "box.obj", "z").colors
    np.testing.assert_allclose(colors, np.broadcast_to([1.0, 0.0, 0.0], colors.shape))


HOSTILE = {
    "more rows than bytes.ply": ply("ascii 1.0\nelement vertex 1000000000\nproperty float x", b"1\n"),
    "rows without properties.ply": ply("ascii 1.0\nelement vertex 9\nelement face 1000000000", b"1\n" * 99),
    "binary rows without properties.ply": ply("binary_little_endian 1.0\nelement vertex 1000000000"),
    "a long list.ply": ply(
        "binary_little_endian 1.0\nelement face 1\nproperty list uint int vertex_indices", b"\xff" * 64
    ),
    "a negative count.ply": ply("ascii 1.0\nelement vertex -5\nproperty float x", b"1\n"),
    "no end.ply": b"ply\nformat ascii 1.0\n" + b"comment\n" * 100_000,
    "an index beyond.obj": POINTS.encode() + b"f 1 2 1000000000000\n",
    "a long number.obj": b"v " + b"9" * 100_000 + b" 0 0\n" + TRIANGLES.encode(),
    "nothing.obj": b"",
    "more than there is.off": b"OFF\n1000000000 1000000000 0\n0 0 0\n",
    "more than there is.stl": bytes(80) + struct.pack("<I", 1 << 31) + bytes(50),
    "more than there is.glb": glb(
        {
            "asset": {"version": "2.0"},
            "accessors": [{"count": 10**10, "componentType": 5126, "type": "VEC3"}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}],
        }
    ),
    "a scene of copies.glb": glb(
        {
            "asset": {"version": "2.0"},
            "accessors": [{"count": 4000, "componentType": 5126, "type": "VEC3", "bufferView": 0}],
            "bufferViews": [{"buffer": 0, "byteLength": 48_000}],
            "buffers": [{"byteLength": 48_000}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "nodes": [{"mesh": 0}] * 10_000,
            "scenes": [{"nodes": list(range(10_000))}],
        },
        bytes(48_000),
    ),
    "another kind.dae": b"<COLLADA/>",
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("reader", [read_mesh, lambda file: read_shape(file, "z")], ids=["mesh", "shape"])
def test_little_that_asks_for_much(tmp_path: Path, name: str, reader: object) -> None:
    (tmp_path / name).write_bytes(HOSTILE[name])
    began = time.process_time()
    tracemalloc.start()
    with pytest.raises(InputError, match=r": .*expected .*found") as caught:
        reader(tmp_path / name)  # type: ignore[operator]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(caught.value).startswith(str(tmp_path / name)) and len(str(caught.value).splitlines()) == 1
    assert peak < 100 * MIB and time.process_time() - began < 5


def test_thousands_of_materials(tmp_path: Path) -> None:
    file = tmp_path / "parts.obj"
    file.write_text(POINTS * 500 + "".join(f"usemtl m{i}\nf 1 2 3\n" for i in range(3000)))
    assert len(read_mesh(file)[1]) == 3000
    with pytest.raises(InputError, match="3000 materials and groups, more than 1000"):
        read_shape(file, "z")


@pytest.mark.parametrize("beside", ["a pipe", "another folder", "another format", "a device"])
def test_what_a_mesh_names_beside_itself(tmp_path: Path, beside: str) -> None:
    """The shape is read without what is no file of its own; nothing waits for a pipe."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    name = "../secret.mtl" if beside == "another folder" else "box.mtl"
    if beside == "a pipe":
        os.mkfifo(folder / name)
    elif beside == "a device":
        (folder / name).symlink_to("/dev/zero")
    else:
        (folder / name).write_text("newmtl m\nmap_Kd red.png\n")
    stream = io.BytesIO()
    Image.new("RGB", (4, 4), (255, 0, 0)).save(stream, "GIF" if beside == "another format" else "PNG")
    (folder / "red.png").write_bytes(stream.getvalue())
    faces = "".join(f"f {a}/1 {b}/1 {c}/1\n" for a, b, c in FACES + 1)
    (folder / "box.obj").write_text(f"mtllib {name}\n{POINTS}vt 0 0\nusemtl m\n{faces}")
    shape = read_shape(folder / "box.obj", "z")
    assert len(shape.faces) == len(FACES)
    assert not np.allclose(shape.colors[:, 1:], 0.0)


def test_a_mesh_that_is_a_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "box.ply")
    for reader in (read_mesh, lambda file: read_shape(file, "z")):
        with pytest.raises(InputError, match=r"box\.ply: expected a triangle mesh, found a pipe"):
            reader(tmp_path / "box.ply")

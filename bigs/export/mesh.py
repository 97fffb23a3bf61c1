"""A mesh as a PLY, OBJ or GLB file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from bigs.atomic import atomic_write
from bigs.checks import InputError, check_choice, check_finite, check_shape

MESH_FORMATS = ("ply", "obj", "glb")


def save_mesh(
    path: str | Path, verts: np.ndarray, faces: np.ndarray, colors: np.ndarray | None = None
) -> None:
    """Write a triangle mesh in the format of the file's suffix; `path` is whole or absent.

    Args:
        path: ends with .ply, .obj or .glb.
        verts: [V, 3] metres; written as they are, whatever axes the format's viewers expect.
        faces: [F, 3] indices into `verts`.
        colors: one colour per vertex, [V, 3] in [0, 1].

    Raises:
        InputError: unknown suffix, a shape that does not fit, a value that is not finite, or a face that
            refers to no vertex.
    """
    kind = Path(path).suffix.lower().removeprefix(".")
    check_choice(f"{path}: suffix", kind, MESH_FORMATS)
    check_shape(f"{path}: vertices", verts, ("V", 3))
    check_shape(f"{path}: faces", faces, ("F", 3))
    check_finite(f"{path}: vertices", verts)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(verts)):
        raise InputError(
            f"{path}: faces: expected indices from 0 to {len(verts) - 1}, "
            f"found {int(faces.min())} to {int(faces.max())}"
        )
    bytes_per_vertex = None
    if colors is not None:
        check_shape(f"{path}: colors", colors, (len(verts), 3))
        check_finite(f"{path}: colors", colors)
        bytes_per_vertex = _bytes(colors)
    mesh = trimesh.Trimesh(verts, faces, vertex_colors=bytes_per_vertex, process=False)
    content: Any = mesh.export(file_type=kind)
    with atomic_write(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def save_meshes(
    path: str | Path,
    meshes: Mapping[str, tuple[np.ndarray, np.ndarray]],
    colors: Mapping[str, np.ndarray],
) -> None:
    """Write several meshes as one OBJ file with an object for each name; `path` is whole or absent.

    Args:
        path: the .obj file.
        meshes: name -> vertices [V, 3] metres, written as they are, and faces [F, 3].
        colors: name -> one colour per vertex, [V, 3] in [0, 1]: three more numbers in its line, which most
            programs read.
    """
    scene = trimesh.Scene()
    for name, (verts, faces) in meshes.items():
        mesh = trimesh.Trimesh(verts, faces, vertex_colors=_bytes(colors[name]), process=False)
        scene.add_geometry(mesh, geom_name=name)
    content: Any = scene.export(file_type="obj")
    with atomic_write(path) as file:
        file.write(content.encode())


def _bytes(colors: np.ndarray) -> np.ndarray:
    return np.round(255.0 * np.clip(colors, 0.0, 1.0)).astype(np.uint8)

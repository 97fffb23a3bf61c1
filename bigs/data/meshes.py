"""Reading a triangle mesh from whatever file it lies in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from bigs.checks import InputError, check_faces, check_finite
from bigs.data.mesh_files import load_mesh_file

# Objects for two hands are between 2 mm and 2 m long.
SHORTEST_M, LONGEST_M = 0.002, 2.0
# A sheet of paper is the flattest: 0.1 mm to 300 mm.
_LEAST_DEPTH = 1e-4
# Surface area over squared length: 0.06 for a knitting needle.
_LEAST_AREA = 1e-3


def read_mesh(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3] as they are stored: nothing is merged, no unit converted.

    Raises:
        InputError: no such file, it holds no triangles, a vertex is not finite, or a face names none.
    """
    mesh = load_mesh_file(file, "a triangle mesh", trimesh.load_mesh)
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"{file}: expected a triangle mesh, found one without faces")
    verts, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    check_finite(f"{file}: vertices", verts)
    check_faces(f"{file}: faces", faces, len(verts))
    return verts, faces


def check_solid(where: str, verts: np.ndarray, faces: np.ndarray) -> None:
    """Raise `InputError` unless a mesh can be the surface of something that two hands hold.

    What has no extent or hardly any surface fits every shape after a similarity alignment, and scores well.

    Args:
        where: what to call it in messages.
        verts: [V, 3] metres, finite.
        faces: [F, 3], in range.
    """
    corners = verts[faces]
    used = corners.reshape(-1, 3)
    spans = np.linalg.svd(used - used.mean(axis=0), compute_uv=False) if len(used) else np.zeros(3)
    size = float(np.ptp(used, axis=0).max()) if len(used) else 0.0
    if not SHORTEST_M < size < LONGEST_M:
        raise InputError(
            f"{where}: expected a surface of {SHORTEST_M:g} to {LONGEST_M:g} m, found one of {size:.3g} m"
        )
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * float(np.linalg.norm(normals, axis=1).sum())
    if spans[-1] < _LEAST_DEPTH * spans[0] or area < _LEAST_AREA * size**2:
        raise InputError(
            f"{where}: expected the surface of a solid, found {len(faces)} faces of {1e4 * area:.3g} cm² "
            f"that span {'a plane' if area >= _LEAST_AREA * size**2 else 'hardly anything'}"
        )

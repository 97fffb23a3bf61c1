"""Reading a triangle mesh from whatever file it lies in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from bigs.checks import InputError


def read_mesh(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3] as they are stored: nothing is merged, no unit converted.

    Raises:
        InputError: no such file, or it holds no triangles.
    """
    if not file.is_file():
        raise InputError(f"{file}: expected a triangle mesh, found no such file")
    try:
        mesh = trimesh.load_mesh(file, process=False, maintain_order=True)
    except Exception as error:  # trimesh's readers raise whatever their parsing trips over
        raise InputError(f"{file}: expected a triangle mesh, found {error or type(error).__name__}") from None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"{file}: expected a triangle mesh, found one without faces")
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)

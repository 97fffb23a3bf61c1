"""A family of objects for training priors: boxes, cans, bottles and jugs, one drawn for each seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh


def procedural_mesh(seed: int) -> trimesh.Trimesh:
    """A container of random kind, proportions and colours, 10 to 20 cm high, z up, about its middle."""
    rng = np.random.default_rng(seed)
    height, wide, deep = rng.uniform(0.1, 0.2), rng.uniform(0.05, 0.09), rng.uniform(0.03, 0.09)
    kind = seed % 3
    if kind == 0:
        mesh = trimesh.creation.box((wide, deep, height))
        mesh = mesh.subdivide().subdivide().subdivide().subdivide()
    else:
        shoulder, neck = (1.0, 1.0) if kind == 1 else (rng.uniform(0.55, 0.75), rng.uniform(0.25, 0.5))
        half = 0.5 * neck
        outline = np.array([[0, 0], [0.5, 0], [0.5, shoulder], [half, 0.5 + 0.5 * shoulder], [half, 1]])
        steps = np.linspace(0, 1, 33)
        length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))]
        fine = np.stack([np.interp(steps * length[-1], length, outline[:, i]) for i in range(2)], axis=-1)
        fine = np.concatenate([fine, [[0.0, 1.0]]])
        mesh = trimesh.creation.revolve(fine, sections=48)
        mesh.apply_scale([wide, deep if kind == 2 else wide, height])
    verts = np.asarray(mesh.vertices) - 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    level = (verts[:, 2] / height) + 0.5
    base, band = rng.uniform(0.15, 0.95, (2, 3))
    low, high = np.sort(rng.uniform(0.15, 0.8, 2))
    colors = np.where(((level > low) & (level < high))[:, None], band, base)
    colors = (255 * colors).round().astype(np.uint8)
    return trimesh.Trimesh(verts, mesh.faces, vertex_colors=colors, process=False)


def write_meshes(folder: Path, count: int, first_seed: int) -> list[Path]:
    """Write `count` of them as PLY files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{first_seed + index:06d}.ply" for index in range(count)]
    for index, path in enumerate(paths):
        procedural_mesh(first_seed + index).export(path)
    return paths

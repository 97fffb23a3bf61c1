"""Triangle meshes: normals, samples, midpoint subdivision as a linear map, spacing of points."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.spatial
import trimesh


def vertex_normals(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals [V, 3] of a mesh with outward winding; zero for a vertex of no face."""
    corners = verts[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(verts)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], face_normals)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)


def face_areas(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Areas [F] of the triangles, in squared units of `verts`."""
    corners = verts[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * np.linalg.norm(cross, axis=-1)


def sample_surface(verts: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """About `count` evenly spread surface points [N, 3] and their unit outward normals [N, 3]."""
    mesh = trimesh.Trimesh(verts, faces, process=False)
    points, face = trimesh.sample.sample_surface_even(mesh, count, seed=0)
    return np.asarray(points), np.asarray(mesh.face_normals[face])


def midpoint_subdivision(faces: np.ndarray, n_verts: int) -> tuple[scipy.sparse.csr_matrix, np.ndarray]:
    """One midpoint subdivision as a linear map on vertices, so that every vertex attribute can follow.

    Args:
        faces: [F, 3].
        n_verts: V, the number of vertices that `faces` refer to.

    Returns:
        A sparse [V + E, V] matrix whose rows sum to one (old vertices first), and faces [4F, 3].
    """
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middle = n_verts + inverse.reshape(-1, 3)
    a, b, c = faces.T
    ab, bc, ca = middle.T
    fine = np.concatenate(
        [np.stack(corner, axis=1) for corner in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
    rows = np.concatenate([np.arange(n_verts), np.repeat(np.arange(len(unique)) + n_verts, 2)])
    cols = np.concatenate([np.arange(n_verts), unique.reshape(-1)])
    values = np.concatenate([np.ones(n_verts), np.full(2 * len(unique), 0.5)])
    return scipy.sparse.csr_matrix((values, (rows, cols)), shape=(n_verts + len(unique), n_verts)), fine


def point_spacing(points: np.ndarray, neighbours: int = 4) -> np.ndarray:
    """Mean distance [N] from each point to its nearest neighbours, in the units of `points`."""
    distances, _ = scipy.spatial.cKDTree(points).query(points, k=min(neighbours + 1, len(points)))
    return distances[:, 1:].mean(axis=1) if len(points) > 1 else np.zeros(len(points))


def frames_from_normals(normals: np.ndarray) -> np.ndarray:
    """Rotations [N, 3, 3] whose third column is the unit normal [N, 3]; the others are any tangents."""
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    tangent = np.cross(helper, normals)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), 1e-12)
    return np.stack([tangent, np.cross(normals, tangent), normals], axis=-1)

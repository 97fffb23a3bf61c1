"""Isotropic remeshing of an implicit surface: a fine marching-cubes mesh to few, well-shaped triangles.

Rounds of collapsing short edges, flipping edges towards Delaunay, and relaxing vertices on the surface. Every
step picks edges that are far enough apart to be changed at once, so it is all array work; the result depends
on nothing but the input. A closed manifold stays closed and manifold: the link condition is checked.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse
from skimage.measure import marching_cubes

from bigs.geometry.mesh import vertex_normals

Field = Callable[[np.ndarray], np.ndarray]


def implicit_mesh(
    distance: Field, lower: np.ndarray, upper: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Marching cubes of `distance` = 0 in a box, with outward winding.

    Args:
        distance: signed distance [...] of points [..., 3], negative inside.
        lower, upper: corners [3] of a box around the surface.
        step: grid spacing, metres.

    Returns:
        vertices [V, 3] and faces [F, 3].
    """
    axes = [np.arange(low, high + step, step) for low, high in zip(lower, upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    vertices, faces, _, _ = marching_cubes(distance(grid), 0.0, spacing=(step,) * 3)
    return vertices + lower, faces.astype(np.int64)


def remesh(
    vertices: np.ndarray, faces: np.ndarray, distance: Field, edge_length: Field, rounds: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Coarsen a fine closed mesh of `distance` = 0 to edges of about `edge_length`.

    Args:
        vertices: [V, 3]; faces: [F, 3].
        distance: signed distance [...] of points [..., 3].
        edge_length: wanted length [...] at points [..., 3], longer than the mesh's own edges.
        rounds: repetitions of collapse, flip and relax after the first, coarsest collapse.
    """
    # Marching cubes leaves slivers, whose normals say nothing; smooth them before any collapse is judged.
    vertices = _project(_relaxed(vertices, faces), distance)
    for _ in range(rounds):
        vertices, faces = _collapse_short_edges(vertices, faces, edge_length)
        faces = _flip_to_delaunay(vertices, faces)
        for _ in range(3):
            vertices = _project(_relaxed(vertices, faces), distance)
    return vertices, faces


def _face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals [F, 3] as long as twice the area."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return np.cross(b - a, c - a)


def unique_edges(faces: np.ndarray) -> np.ndarray:
    """Each edge [E, 2] once, smaller vertex number first."""
    first, second = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    # One number per edge: sorting numbers is far faster than sorting rows.
    span = int(faces.max()) + 1
    keys = np.unique(np.minimum(first, second) * span + np.maximum(first, second))
    return np.stack(np.divmod(keys, span), axis=1)


def adjacency(faces: np.ndarray, vertices: int) -> scipy.sparse.csr_matrix:
    """Symmetric 0/1 matrix [V, V] of the vertices joined by an edge."""
    first, second = unique_edges(faces).T
    ones = np.ones(2 * len(first), dtype=np.int64)
    rows, columns = np.concatenate([first, second]), np.concatenate([second, first])
    return scipy.sparse.csr_matrix((ones, (rows, columns)), shape=(vertices, vertices))


def _project(vertices: np.ndarray, distance: Field) -> np.ndarray:
    """Two Newton steps onto `distance` = 0, with a forward-difference gradient."""
    step = 1e-6
    for _ in range(2):
        value = distance(vertices)
        gradient = np.stack([distance(vertices + step * axis) - value for axis in np.eye(3)], axis=-1) / step
        vertices = vertices - value[:, None] * gradient / np.maximum((gradient**2).sum(-1), 0.1)[:, None]
    return vertices


def _relaxed(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Each vertex moved half way to the mean of its neighbours, within its tangent plane."""
    neighbours = np.bincount(unique_edges(faces).ravel(), minlength=len(vertices))
    towards = adjacency(faces, len(vertices)) @ vertices / neighbours[:, None] - vertices
    normals = vertex_normals(vertices, faces)
    towards -= (towards * normals).sum(1, keepdims=True) * normals
    return vertices + 0.5 * towards


def _collapse_short_edges(
    vertices: np.ndarray, faces: np.ndarray, edge_length: Field
) -> tuple[np.ndarray, np.ndarray]:
    """Collapse edges shorter than 4/5 of the wanted length, shortest first, until none is left that may go.

    An edge whose collapse would fold the surface stays, and so do the others at its ends, until next round.
    """
    stuck = np.zeros(len(vertices), dtype=bool)
    while True:
        edges = unique_edges(faces)
        middle = vertices[edges].mean(axis=1)
        length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        short = length / edge_length(middle)
        links = adjacency(faces, len(vertices))
        candidates = np.flatnonzero((short < 0.8) & ~stuck[edges].any(axis=1))
        # Link condition: the ends of an edge of a closed surface share just the two vertices opposite to it.
        a, b = edges[candidates].T
        shared = np.asarray(links[a].multiply(links[b]).sum(axis=1)).ravel()
        candidates = candidates[shared == 2]
        chosen = candidates[_far_apart(edges[candidates], short[candidates], links)]
        target = middle[chosen]
        good = _keeps_normals(vertices, faces, edges[chosen], target)
        if not len(chosen):
            return vertices, faces
        stuck[edges[chosen[~good]]] = True
        keep, gone = edges[chosen[good]].T
        vertices = vertices.copy()
        vertices[keep] = target[good]
        vertices, faces, left = _merge(vertices, faces, keep, gone)
        stuck = stuck[left]


def _far_apart(edges: np.ndarray, priority: np.ndarray, links: scipy.sparse.csr_matrix) -> np.ndarray:
    """The edges that come before every other edge touching the neighbours of their ends."""
    rank = np.empty(len(edges))
    rank[np.lexsort((edges[:, 1], edges[:, 0], priority))] = np.arange(len(edges))
    lowest = np.full(links.shape[0], np.inf)
    for end in range(2):
        np.minimum.at(lowest, edges[:, end], rank)
    around = lowest.copy()
    pairs = links.tocoo()
    np.minimum.at(around, pairs.row, lowest[pairs.col])
    return np.flatnonzero((around[edges[:, 0]] == rank) & (around[edges[:, 1]] == rank))


def _keeps_normals(
    vertices: np.ndarray, faces: np.ndarray, edges: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """For edges far apart, whether moving both ends to `target` turns no face by more than 70 degrees."""
    owner = np.full(len(vertices), -1)
    moved = vertices.copy()
    for end in range(2):
        owner[edges[:, end]] = np.arange(len(edges))
        moved[edges[:, end]] = target
    touched = owner[faces]
    edge_of_face = touched.max(axis=1)
    changes = ((touched >= 0).sum(axis=1) == 1).nonzero()[0]
    before, after = _face_normals(vertices, faces[changes]), _face_normals(moved, faces[changes])
    cosine = (before * after).sum(1) / np.maximum(
        np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1), 1e-18
    )
    good = np.ones(len(edges), dtype=bool)
    good[edge_of_face[changes[cosine < 0.34]]] = False
    return good


def _merge(
    vertices: np.ndarray, faces: np.ndarray, keep: np.ndarray, gone: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Replace `gone` by `keep`, drop faces that became edges, renumber; also returns the remaining
    vertices."""
    number = np.arange(len(vertices))
    number[gone] = keep
    faces = number[faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    left = np.ones(len(vertices), dtype=bool)
    left[gone] = False
    return vertices[left], (np.cumsum(left) - 1)[faces[whole]], left


def _flip_to_delaunay(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Flip edges whose opposite angles sum to more than pi, as long as there are any."""
    for _ in range(10):
        half = faces[:, [0, 1, 2, 1, 2, 0, 2, 0, 1]].reshape(-1, 3)  # from, to, opposite
        face = np.repeat(np.arange(len(faces)), 3)
        order = np.lexsort((half[:, 0] > half[:, 1], half[:, :2].max(axis=1), half[:, :2].min(axis=1)))
        first, second = order[0::2], order[1::2]
        a, b, c = half[first].T
        d = half[second, 2]
        angle = _angle(vertices, c, a, b) + _angle(vertices, d, a, b)
        links = adjacency(faces, len(vertices))
        free = np.asarray(links[c, d]).ravel() == 0
        candidates = np.flatnonzero((angle > np.pi + 0.05) & free)
        # Two flips may share no face and make no edge twice: take the worst edge around every vertex.
        rank = np.empty(len(candidates))
        rank[np.argsort(-angle[candidates], kind="stable")] = np.arange(len(candidates))
        quad = np.stack([a, b, c, d], axis=1)[candidates]
        lowest = np.full(len(vertices), np.inf)
        np.minimum.at(lowest, quad.ravel(), np.repeat(rank, 4))
        chosen = candidates[(lowest[quad] == rank[:, None]).all(axis=1)]
        old, new = _flipped(faces, face, first, second, half, d, chosen)
        turned = (_face_normals(vertices, old) * _face_normals(vertices, new)).sum(1).reshape(2, -1).min(
            0
        ) > 0
        chosen = chosen[turned]
        if not len(chosen):
            return faces
        faces = faces.copy()
        a, b, c, d = a[chosen], b[chosen], c[chosen], d[chosen]
        faces[face[first[chosen]]] = np.stack([a, d, c], axis=1)
        faces[face[second[chosen]]] = np.stack([d, b, c], axis=1)
    return faces


def _flipped(
    faces: np.ndarray,
    face: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    half: np.ndarray,
    d: np.ndarray,
    chosen: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The faces on both sides of the chosen edges, before and after the flip."""
    a, b, c = half[first[chosen]].T
    old = np.concatenate([faces[face[first[chosen]]], faces[face[second[chosen]]]])
    new = np.concatenate([np.stack([a, d[chosen], c], axis=1), np.stack([d[chosen], b, c], axis=1)])
    return old, new


def _angle(vertices: np.ndarray, at: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The angle at a vertex between two others, radians."""
    u, v = vertices[one] - vertices[at], vertices[other] - vertices[at]
    return np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(1))

"""The object's mesh from what its Gaussians have learned, together with the surface that they started from.

The start knows the surface from points and outlines, the Gaussians from colours and outlines in the poses
that were found. They err on their own and by about as much, so their middle is nearer to the truth than
either.
"""

from __future__ import annotations

import numpy as np
import scipy.spatial
import torch
import trimesh

from bigs.geometry.mesh import vertex_normals
from bigs.models.canonical import CanonicalObject
from bigs.models.scene import ObjectSurface

# One Gaussian goes astray easily, so they speak together: weights fall off with this standard deviation along
# the surface, metres, among so many neighbours.
_ALONG = 0.007
_NEIGHBOURS = 60
# Gaussians further off than this belong to another side, and so do those whose normals differ by more.
_FURTHEST = 0.008
_LEAST_COSINE = 0.85
# Below this sum of weights nobody knows better than the start.
_LEAST_WEIGHT = 0.5
# Share of the way from the start to the Gaussians.
_SHARE = 0.5
# Steps of smoothing, each there and back so that the object does not shrink: what is smaller than a few cells
# of the start's grid is noise of either.
_SMOOTHING = 20
_THERE, _BACK = 0.5, 0.53


def learned_surface(surface: ObjectSurface, whole: CanonicalObject) -> ObjectSurface:
    """The surface half-way to where the object's Gaussians lie about each vertex, along its normal; smoothed.

    Args:
        surface: of the object.
        whole: its N Gaussians, in the same frame and units.
    """
    verts, faces = surface.verts.double().numpy(), surface.faces.numpy()
    means = whole.means.detach().double().numpy()
    normals = vertex_normals(verts, faces)
    count = min(_NEIGHBOURS, len(means))
    near = scipy.spatial.cKDTree(means).query(verts, k=range(1, count + 1))[1]
    apart = means[near] - verts[:, None]  # [V, k, 3]
    facing = whole.normals.detach().numpy()[near]
    cosine = (facing * normals[:, None]).sum(-1)
    # Along the middle of both normals, which on a round surface is right for neighbours, too: along the
    # vertex' own they would all lie too deep.
    height = (apart * (facing + normals[:, None])).sum(-1) / (1.0 + cosine).clip(1.0)
    along = ((apart**2).sum(-1) - height**2).clip(0.0)
    weight = whole.opacities.detach().numpy()[near] * np.exp(-0.5 * along / _ALONG**2)
    weight *= (cosine > _LEAST_COSINE) & (np.abs(height) < _FURTHEST)
    total = weight.sum(1)
    learned = (weight * height).sum(1) / total.clip(1e-12)
    shift = np.where(total > _LEAST_WEIGHT, _SHARE * learned, 0.0)
    mesh = trimesh.Trimesh(verts + shift[:, None] * normals, faces, process=False)
    trimesh.smoothing.filter_taubin(mesh, _THERE, _BACK, _SMOOTHING)
    return ObjectSurface(torch.as_tensor(mesh.vertices, dtype=surface.verts.dtype), surface.faces)

"""Normals of a point cloud, and which of their two sides is outside."""

from __future__ import annotations

import numpy as np
import scipy.spatial

from bigs.geometry.coverage import ObjectViews, times_seen
from bigs.geometry.surface import VisualHull

# Frames that must show one side of a point more often than the other before that says much.
_SIGHTINGS = 3.0
# Neighbours of a point to which its surface goes on.
_BETWEEN = 8
# Neighbours that say where a normal points, the smallest cosine between two normals of one plane (of either
# sign), how far a neighbour may lie from the plane as a share of its distance, and how often evidence is
# passed on.
_NEIGHBOURS, _LEAST_ALIKE, _MOST_OFF, _ROUNDS = 16, 0.7, 0.35, 3


def point_normals(points: np.ndarray, outward: np.ndarray, neighbours: int = 12) -> np.ndarray:
    """Normals of a point cloud by local planes, turned towards the directions `outward` [N, 3]."""
    _, index = scipy.spatial.cKDTree(points).query(points, k=min(neighbours, len(points)))
    patches = points[index] - points[index].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", patches, patches))
    normals = axes[:, :, 0]
    return normals * np.where((normals * outward).sum(-1, keepdims=True) < 0, -1.0, 1.0)


def outward_normals(
    points: np.ndarray, hull: VisualHull, views: ObjectViews, spacing: float, tolerance: float
) -> np.ndarray:
    """Normals of an object's points, outward by two kinds of evidence together.

    A point faces the cameras that can have seen it, which says little of one that was only seen edge-on. The
    hull's slope points out of the object, but a hull of few directions is deep, and rough outlines are rough.

    Args:
        points: [N, 3] metres.
        hull: what silhouettes leave of the object.
        views: the frames that saw it.
        spacing: of the grid on which the hull is looked at, metres.
        tolerance: by which errors of poses may put a point behind one that hides it, metres.

    Returns:
        Unit normals [N, 3].
    """
    # Wider than the roughness that errors of outlines leave.
    slope = hull.slope(points, 2.0 * spacing)
    away = points - points.mean(0)
    # Deep inside the slope is zero; there the direction from the middle decides.
    slope += 1e-3 * away / np.linalg.norm(away, axis=-1, keepdims=True).clip(1e-9)
    normals = point_normals(points, slope)
    # Between points, too, there is surface that hides what lies behind.
    _, index = scipy.spatial.cKDTree(points).query(points, k=min(_BETWEEN + 1, len(points)))
    surface = np.concatenate([points, (0.5 * (points[:, None] + points[index[:, 1:]])).reshape(-1, 3)])
    ahead, behind = (
        times_seen(views, points, sign * normals, surface, tolerance).astype(float) for sign in (1.0, -1.0)
    )
    seen = (ahead - behind) / (ahead + behind + _SIGHTINGS)
    return turned_alike(points, normals, seen + (slope * normals).sum(-1))


def turned_alike(points: np.ndarray, normals: np.ndarray, evidence: np.ndarray) -> np.ndarray:
    """Normals turned to the side for which they and those of neighbours in their plane have more evidence.

    Args:
        points: [N, 3] metres.
        normals: [N, 3] unit, of either sign.
        evidence: [N] positive where something says that a normal points outward, negative where inward.
    """
    count = min(_NEIGHBOURS + 1, len(points))
    distance, index = (found[:, 1:] for found in scipy.spatial.cKDTree(points).query(points, k=count))
    alike = np.einsum("nd,nkd->nk", normals, normals[index])
    # The other wall of something thin is near, too, but not in the plane.
    off = np.abs(np.einsum("nkd,nd->nk", points[index] - points[:, None], normals))
    weights = np.where((np.abs(alike) > _LEAST_ALIKE) & (off < _MOST_OFF * distance), alike, 0.0)
    weights /= np.abs(weights).sum(1, keepdims=True).clip(1e-9)
    for _ in range(_ROUNDS):
        evidence = 0.3 * evidence + 0.7 * (weights * evidence[index]).sum(1)
    return normals * np.where(evidence < 0.0, -1.0, 1.0)[:, None]

"""The object's points after structure from motion: without outliers, coloured, at unit size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bigs.motion.object_map import ObjectMap


def trim_points(points: np.ndarray) -> np.ndarray:
    """Which points [N] (bool) lie within 1.5 times the 80th percentile of the distances from their median."""
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return distance <= 1.5 * np.percentile(distance, 80)


def normalisation(points: np.ndarray) -> np.ndarray:
    """HOLD's `norm_mat` [4, 4]: moves the bounding box's centre to 0 and the farthest point to distance 1."""
    centre = 0.5 * (points.min(0) + points.max(0))
    radius = np.linalg.norm(points - centre, axis=1).max()
    matrix = np.diag([1.0 / radius] * 3 + [1.0])
    matrix[:3, 3] = -centre / radius
    return matrix


def color_points(map_: ObjectMap, tracks: np.ndarray, images: Sequence[np.ndarray]) -> np.ndarray:
    """Colours [N, 3] uint8 of the points `tracks` [N]: the median over their observations' pixels."""
    rows, index = _observations(map_, tracks)
    column, row = np.floor(map_.pixels[rows]).astype(int).T
    found = np.empty((len(rows), 3))
    for t in np.unique(map_.frame[rows]):
        here = map_.frame[rows] == t
        height, width = images[t].shape[:2]
        found[here] = images[t][row[here].clip(0, height - 1), column[here].clip(0, width - 1)]
    order = np.argsort(index, kind="stable")
    _, starts = np.unique(index[order], return_index=True)
    medians = [np.median(group, axis=0) for group in np.split(found[order], starts[1:])]
    return np.round(medians).astype(np.uint8).reshape(-1, 3)


def _observations(map_: ObjectMap, tracks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The map's observations [M] of `tracks` [N] that are believed, and which of them each shows [M]."""
    slot = np.full(len(map_.points), -1)
    slot[tracks] = np.arange(len(tracks))
    rows = np.flatnonzero(map_.use() & (slot[map_.track] >= 0))
    return rows, slot[map_.track[rows]]


def sure_sightings(map_: ObjectMap, tracks: np.ndarray) -> np.ndarray:
    """Frame and index among `tracks` [N] of each sighting [M, 2] of those whose place is sure.

    A wrong match is rarely confirmed by many frames, and a point that was seen from one side alone may lie
    anywhere along its ray.
    """
    rows, index = _observations(map_, tracks)
    frame = map_.frame[rows]
    eyes = -np.einsum("tji,tj->ti", map_.rotations, map_.transl)
    rays = map_.points[map_.track[rows]] - eyes[frame]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    mean = np.zeros((len(tracks), 3))
    np.add.at(mean, index, rays)
    mean /= np.linalg.norm(mean, axis=1, keepdims=True).clip(1e-9)
    cosine = np.ones(len(tracks))
    np.minimum.at(cosine, index, (rays * mean[index]).sum(1))
    often = np.bincount(index, minlength=len(tracks)) >= _SURE_SIGHTINGS
    sure = often & (cosine < np.cos(np.radians(_SURE_ANGLE)))
    return np.stack([frame, index], axis=1)[sure[index]]


# How often a point must be seen, and by how much its rays must leave their mean (degrees), before its place
# is sure.
_SURE_SIGHTINGS, _SURE_ANGLE = 6, 10.0

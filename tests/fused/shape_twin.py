"""The slow twins of `bigs.fused.shape`: the same by formulas on whole arrays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.ndimage
import scipy.spatial

from bigs.fused.shape import Poses
from bigs.geometry.symmetry import EmptySpace, SeenSurface, Symmetry


def places(poses: Poses, t: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Column and row of points [N, 3], where the first pixel's middle is at (0.5, 0.5), and their depths."""
    cam = points @ poses.rotations[t].T + poses.centers[t]
    depth = np.where(cam[:, 2] > 1e-3, cam[:, 2], np.nan)
    column, row = ((cam[:, :2] / depth[:, None]) * poses.K[[0, 1], [0, 1]] + poses.K[:2, 2]).T
    return column, row, depth


def cone_distances(
    silhouettes: np.ndarray, poses: Poses, points: np.ndarray, order: np.ndarray, agreeing: int, stop: float
) -> np.ndarray:
    height, width = silhouettes.shape[1:]
    largest = np.full((agreeing, len(points)), -np.inf)
    active = np.arange(len(points))
    for t in order:
        column, row, depth = places(poses, t, points[active])
        u, v = column - 0.5, row - 0.5
        seen = (u > 0) & (v > 0) & (u < width - 1) & (v < height - 1)
        pixels = scipy.ndimage.map_coordinates(
            silhouettes[t].astype(float), np.stack([v[seen], u[seen]]), order=1, prefilter=False
        )
        index, found = active[seen], pixels * depth[seen] / poses.K[0, 0]
        for rank in largest:
            rank[index], found = np.maximum(rank[index], found), np.minimum(rank[index], found)
        active = active[largest[-1, active] <= stop]
    return np.where(np.isfinite(largest[-1]), largest[-1], -1.0)


def pixels(
    shape: tuple[int, ...], poses: Poses, t: int, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Row and column of the pixels of points [N, 3], their depths, and which are in the picture."""
    column, row, depth = places(poses, t, points)
    inside = (column >= 0) & (row >= 0) & (column < shape[1]) & (row < shape[0])
    return np.where(inside, row, 0).astype(int), np.where(inside, column, 0).astype(int), depth, inside


def nearest_depths(shape: tuple[int, ...], poses: Poses, t: int, surface: np.ndarray) -> np.ndarray:
    row, column, depth, inside = pixels(shape, poses, t, surface)
    buffer = np.full(shape, np.inf)
    np.minimum.at(buffer, (row[inside], column[inside]), depth[inside])
    return scipy.ndimage.minimum_filter(buffer, 5)


def times_seen(
    shown: np.ndarray,
    poses: Poses,
    points: np.ndarray,
    normals: np.ndarray,
    surface: np.ndarray,
    least_cosine: float,
    tolerance: float,
) -> np.ndarray:
    count = np.zeros(len(points), dtype=int)
    for t, mask in enumerate(shown):
        row, column, depth, inside = pixels(mask.shape, poses, t, points)
        towards = -poses.centers[t] @ poses.rotations[t] - points
        cosine = (towards * normals).sum(-1) / np.linalg.norm(towards, axis=-1)
        slope = np.sqrt(1.0 - cosine.clip(least_cosine, 1.0) ** 2) / cosine.clip(least_cosine, 1.0)
        nearest = nearest_depths(mask.shape, poses, t, surface)[row, column]
        nearest = nearest + 2.0 * depth / poses.K[0, 0] * slope
        count += inside & (cosine > least_cosine) & mask[row, column] & (depth < nearest + tolerance)
    return count


def times_empty(
    shown: np.ndarray, poses: Poses, points: np.ndarray, surface: np.ndarray, tolerance: float
) -> np.ndarray:
    count = np.zeros(len(points), dtype=int)
    for t, mask in enumerate(shown):
        row, column, depth, inside = pixels(mask.shape, poses, t, points)
        nearest = nearest_depths(mask.shape, poses, t, surface)[row, column]
        count += inside & mask[row, column] & np.isfinite(nearest) & (depth < nearest - tolerance)
    return count


def agreement(
    surface: SeenSurface, is_empty: EmptySpace, symmetry: Symmetry, reach: float, least_cosine: float
) -> tuple[float, float, float]:
    """Support, contradiction and the colours' error; an axis carries every eighth sample."""
    tree = scipy.spatial.cKDTree(surface.points)
    every = 8 if symmetry.kind == "axis" else 1
    support, contradiction, errors = [], [], []
    for image in symmetry.images(SeenSurface(*(values[::every] for values in surface))):
        distance, index = tree.query(image.points, distance_upper_bound=reach)
        near = np.isfinite(distance)
        index = np.where(near, index, 0)
        near &= (image.normals * surface.normals[index]).sum(-1) > least_cosine
        support.append(near.mean())
        contradiction.append((is_empty(image.points) & ~near).mean())
        errors.append(np.abs(image.colors[near] - surface.colors[index[near]]).mean(-1))
    return float(np.mean(support)), float(np.mean(contradiction)), float(np.concatenate(errors).mean())


def off_planes(surface: SeenSurface, reach: float) -> Callable[[Symmetry], float]:
    """How far carried samples are from the planes of those they meet within reach, at the median."""
    tree = scipy.spatial.cKDTree(surface.points)

    def median(symmetry: Symmetry) -> float:
        found = []
        for image in symmetry.images(surface):
            distance, index = tree.query(image.points, distance_upper_bound=reach)
            near = np.flatnonzero(np.isfinite(distance))
            met = index[near]
            found.append(((image.points[near] - surface.points[met]) * surface.normals[met]).sum(-1))
        return float(np.median(np.abs(np.concatenate(found))))

    return median

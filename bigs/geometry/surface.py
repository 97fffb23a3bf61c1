"""An object's surface from its silhouettes and a sparse point cloud, as a signed distance on a grid.

The visual hull is right where the object is convex and wrong in hollows and where a hand always hid the
background; points with normals are right where there are points. The two are blended by the distance to the
nearest point, and the hull is cut back to the points' convex hull where there is no evidence beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.sparse.csgraph
import scipy.spatial
import skimage.measure

import bigs.fused.shape as fused
from bigs.threads import thread_count


@dataclass(frozen=True)
class DistanceGrid:
    """Signed distances at the corners of a regular grid; negative inside."""

    values: np.ndarray  # [X, Y, Z] metres
    origin: np.ndarray  # [3] position of values[0, 0, 0]
    spacing: float  # metres between neighbours

    def points(self) -> np.ndarray:
        """Positions [X * Y * Z, 3] of the grid's corners, in the order of `values.ravel()`."""
        axes = [
            origin + self.spacing * np.arange(n)
            for origin, n in zip(self.origin, self.values.shape, strict=True)
        ]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def empty_grid(lower: np.ndarray, upper: np.ndarray, resolution: int) -> DistanceGrid:
    """Zeros over the box from `lower` [3] to `upper` [3], whose longest side has `resolution` cells."""
    spacing = float((upper - lower).max()) / resolution
    shape = np.ceil((upper - lower) / spacing).astype(int) + 1
    return DistanceGrid(np.zeros(shape), lower.copy(), spacing)


def silhouette_around_points(
    allowed: np.ndarray, points_cam: np.ndarray, K: np.ndarray, tolerance: float = 0.006
) -> np.ndarray:
    """`border_distances` of a mask that does not contradict the object's own points.

    A patch of points well outside `allowed` means that something unlabelled hides the object there; single
    ones are strays. Where there are such patches, the mask is opened around them.

    Args:
        allowed: [H, W] bool.
        points_cam: [N, 3] the object's points in camera space, metres.
        K: [3, 3].
        tolerance: metres by which pose errors may put a point outside.
    """
    distance = fused.border_distances(allowed)
    height, width = allowed.shape
    front = points_cam[points_cam[:, 2] > 1e-3]
    pixels = np.rint(front[:, :2] / front[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2] - 0.5).astype(int)
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    if not inside.any():
        return distance
    column, row = pixels[inside].T
    reach = tolerance * K[0, 0] / float(np.median(front[:, 2]))
    outside = distance[row, column] > reach
    hits = np.zeros(allowed.shape, dtype=np.float32)
    np.add.at(hits, (row[outside], column[outside]), 1.0)
    side = 2 * int(np.ceil(reach)) + 1
    together = scipy.ndimage.uniform_filter(hits, side, mode="constant") * side * side
    if together.max() < _PATCH - 0.5:
        return distance
    return fused.border_distances(allowed | (together >= _PATCH - 0.5))


# Multiples of it, less their whole part, are never near to one another for long.
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)

# This many points within reach of one another are no outliers.
_PATCH = 4.0


@dataclass(frozen=True)
class VisualHull:
    """Silhouettes and the poses they were seen from."""

    silhouettes: np.ndarray  # [T, H, W] signed distances in pixels, negative where the object may be
    K: np.ndarray  # [3, 3] intrinsics
    rotations: np.ndarray  # [T, 3, 3]; x_cam = R x + centre
    centers: np.ndarray  # [T, 3] metres
    # How many frames must agree that a point is outside, so that one wrong mask or pose carves nothing.
    agreeing: int = 1

    def distance(self, points: np.ndarray, stop: float = np.inf) -> np.ndarray:
        """Distance of points [N, 3] to the hull: the largest over frames of that to the silhouette's cone.

        Args:
            points: metres, object frame.
            stop: points found to be further outside than this are not looked at again.

        Returns:
            [N] metres, negative inside; a lower bound of the true distance outside. A point that
            fewer than `agreeing` frames see counts as inside by a large amount.
        """
        # Neighbouring frames look from the same side, so that frames far apart settle more points sooner.
        apart = np.argsort(np.arange(len(self.silhouettes)) * _GOLDEN % 1.0, kind="stable")
        return fused.cone_distances(self.silhouettes, self._poses, points, apart, self.agreeing, stop)

    @property
    def _poses(self) -> fused.Poses:
        return fused.Poses(self.K, self.rotations, self.centers)

    def slope(self, points: np.ndarray, step: float) -> np.ndarray:
        """Gradients [N, 3] of `distance` at points [N, 3], by central differences of `step` metres."""
        return np.stack(
            [
                (self.distance(points + step * axis) - self.distance(points - step * axis)) / (2.0 * step)
                for axis in np.eye(3)
            ],
            axis=-1,
        )


def convex_distance(points: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    """Distance [N] of points to the convex hull of `cloud` [M, 3], along its faces; negative inside."""
    return distance_to_planes(points, scipy.spatial.ConvexHull(cloud).equations)


def distance_to_planes(points: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """The largest signed distance [N] of points [N, 3] to planes [M, 4]: unit normal and offset."""
    return fused.beyond_planes(points, planes)


def neighbour_distances(points: np.ndarray, neighbours: int = 6) -> np.ndarray:
    """Mean distance [N] of each point to its nearest `neighbours`, of which there must be as many."""
    distance, _ = scipy.spatial.cKDTree(points).query(points, k=neighbours + 1)
    return distance[:, 1:].mean(axis=1)


def inlier_points(points: np.ndarray, neighbours: int = 6, factor: float = 3.0) -> np.ndarray:
    """Which points [N] (bool) have neighbours as near as the others do; the rest are stray."""
    if len(points) <= neighbours:
        return np.ones(len(points), dtype=bool)
    mean = neighbour_distances(points, neighbours)
    return mean < factor * np.median(mean)


def plane_scatter(points: np.ndarray, normals: np.ndarray, neighbours: int = 8) -> float:
    """How far points [N, 3] lie off the surface, metres: a robust standard deviation along their normals.

    Each is compared with the planes of its nearest `neighbours`, by their unit normals [N, 3].
    """
    count = min(neighbours, len(points) - 1)
    if count < 1:
        return 0.0
    _, index = scipy.spatial.cKDTree(points).query(points, k=count + 1, workers=thread_count())
    others = index[:, 1:]
    off = ((points[:, None] - points[others]) * normals[others]).sum(-1).mean(1)
    # The mean of the planes scatters, too.
    return float(1.4826 * np.median(np.abs(off)) / np.sqrt(1.0 + 1.0 / count))


def blend_with_points(
    grid: DistanceGrid,
    points: np.ndarray,
    normals: np.ndarray,
    reach: float,
    neighbours: int = 8,
) -> DistanceGrid:
    """Replace a grid's distance near points by the distance to their planes (moving least squares).

    The hull bounds the object from outside, but points scatter. If planes could only go inwards from it, the
    surface would follow the inner half of their errors wherever the hull is tight, as it is under rough
    outlines. So they may go outwards as far as the points scatter.

    Args:
        grid: distances to the hull.
        points: [N, 3] metres.
        normals: [N, 3] unit, outward.
        reach: metres; at this distance from the nearest point the grid's own value is back in full.
        neighbours: number of planes that are averaged.

    Returns:
        A new grid. It reaches outside the old one by no more than `plane_scatter` of the points.
    """
    corners = grid.points()
    values = grid.values.ravel().copy()
    # Far outside only the sign matters, and it is known.
    near = np.flatnonzero(values < reach)
    distance, index = scipy.spatial.cKDTree(points).query(
        corners[near], k=min(neighbours, len(points)), distance_upper_bound=reach, workers=thread_count()
    )
    has = np.isfinite(distance[:, 0])
    near, distance, index = near[has], distance[has], index[has]
    weights = np.where(np.isfinite(distance), np.exp(-0.5 * (distance / (0.35 * reach)) ** 2), 0.0)
    index = np.where(np.isfinite(distance), index, 0)
    plane = ((corners[near, None] - points[index]) * normals[index]).sum(-1)
    plane = (weights * plane).sum(1) / weights.sum(1)
    share = 1.0 - distance[:, 0] / reach
    share = share * share * (3.0 - 2.0 * share)
    least = values[near] - share * plane_scatter(points, normals, neighbours)
    values[near] = np.maximum(share * plane + (1.0 - share) * values[near], least)
    return DistanceGrid(values.reshape(grid.values.shape), grid.origin, grid.spacing)


# A piece of a surface is one of its own if this many points lie on it: single ones are strays.
_OWN_POINTS = 8


def extract_mesh(grid: DistanceGrid, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The zero level set's largest piece, and those on which points [N, 3] of the object lie.

    Something thin, such as a handle, may lose its hold where a grid is smoothed.

    Returns:
        Vertices [V, 3] and faces [F, 3] with outward winding.

    Raises:
        ValueError: the grid has no zero crossing.
    """
    padded = np.pad(grid.values, 1, constant_values=max(grid.spacing, float(grid.values.max())))
    verts, faces, _, _ = skimage.measure.marching_cubes(padded, 0.0, spacing=(grid.spacing,) * 3)
    verts = verts + grid.origin - grid.spacing
    label = _components(len(verts), faces)
    count = np.bincount(label[faces[:, 0]])
    kept = np.arange(len(count)) == count.argmax()
    if len(count) > 1:
        owner = label[scipy.spatial.cKDTree(verts).query(points)[1]]
        kept |= np.bincount(owner, minlength=len(count)) >= _OWN_POINTS
    faces = faces[kept[label[faces[:, 0]]]]
    used, faces = np.unique(faces, return_inverse=True)
    verts, faces = verts[used], faces.reshape(-1, 3)
    corners = verts[faces]
    volume = np.einsum("ni,ni->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return verts, faces if volume > 0 else faces[:, ::-1]


def _components(n_verts: int, faces: np.ndarray) -> np.ndarray:
    """Label [V] of the connected piece that each vertex belongs to."""
    pairs = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = scipy.sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(n_verts, n_verts))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1]

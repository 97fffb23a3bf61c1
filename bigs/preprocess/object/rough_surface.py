"""A rough surface of the object from its masks and points: enough to tell how far a hand is from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bigs.geometry.coverage import ObjectViews
from bigs.geometry.normals import outward_normals
from bigs.geometry.spread import spread
from bigs.geometry.surface import (
    DistanceGrid,
    VisualHull,
    blend_with_points,
    convex_distance,
    empty_grid,
    silhouette_around_points,
)
from bigs.types import MASK_VALUES


@dataclass(frozen=True)
class SurfaceConfig:
    """Lengths in metres."""

    resolution: int = 48  # cells along the longest side
    frames: int = 24  # number of silhouettes that carve, spread over the clip
    agreeing: int = 3  # number of them that must agree before a place is carved away
    reach: float = 0.016  # distance from the nearest point at which the hull alone decides
    margin: float = 0.01  # how far the surface may leave the points' convex hull
    possible: float = 0.001  # distance that a hand counts as off where object is possible but not known
    tolerance: float = 0.006  # by which errors of poses may put a point behind one that hides it


class Sights(NamedTuple):
    """What some frames tell about the object's shape."""

    hull: VisualHull  # what their silhouettes leave
    views: ObjectViews  # what they saw of it


def sights(
    points: np.ndarray,
    rotations: np.ndarray,
    transl: np.ndarray,
    confidence: np.ndarray,
    masks: np.ndarray,
    K: np.ndarray,
    config: SurfaceConfig,
) -> Sights:
    """What frames spread over the clip tell about the object's shape.

    Args:
        points: [N, 3] metres, object frame, without strays.
        rotations, transl: [T, 3, 3] and [T, 3], object to camera.
        confidence: [T]; frames that have none do not carve.
        masks: [T, H, W] labels; whatever is not background may hide the object.
        K: [3, 3].
        config: see there.
    """
    usable = np.flatnonzero(confidence > 0) if (confidence > 0).any() else np.arange(len(masks))
    chosen = usable[spread(len(usable), config.frames)]
    silhouettes = [
        silhouette_around_points(masks[t] != 0, points @ rotations[t].T + transl[t], K) for t in chosen
    ]
    poses = (rotations[chosen], transl[chosen])
    return Sights(
        VisualHull(np.stack(silhouettes), K, *poses, min(config.agreeing, len(chosen))),
        ObjectViews(masks[chosen] == MASK_VALUES["object"], K, *poses),
    )


class RoughSurface(NamedTuple):
    """Signed distances to the object, where it is known and where it is not."""

    solid: DistanceGrid  # surface that a hand cannot be inside
    # Surface that a hand touches. Between the solid and the visual hull, where a hand hid the background in
    # every frame, there may be object, such as a grip: `SurfaceConfig.possible`, so that known surface counts
    # more.
    outer: DistanceGrid


def rough_surface(points: np.ndarray, seen: Sights, config: SurfaceConfig) -> RoughSurface:
    """The visual hull blended with the planes of points [N, 3], cut back to near their convex hull."""
    size = float((points.max(0) - points.min(0)).max())
    grid = empty_grid(points.min(0) - 0.15 * size, points.max(0) + 0.15 * size, config.resolution)
    corners = grid.points()
    bound = convex_distance(corners, points) - config.margin
    to_hull = seen.hull.distance(corners, stop=config.reach)
    distance = np.maximum(to_hull, bound)
    carved = DistanceGrid(distance.reshape(grid.values.shape), grid.origin, grid.spacing)
    normals = outward_normals(points, seen.hull, seen.views, grid.spacing, config.tolerance)
    solid = blend_with_points(carved, points, normals, config.reach)
    outer = np.minimum(solid.values, to_hull.reshape(grid.values.shape).clip(0.0) + config.possible)
    return RoughSurface(solid, DistanceGrid(outer, grid.origin, grid.spacing))

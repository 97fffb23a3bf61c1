"""The object's surface at the start where only one side of it was ever looked at."""

from __future__ import annotations

import numpy as np
import pytest

from bigs.geometry.coverage import ObjectViews
from bigs.geometry.surface import DistanceGrid, convex_distance, empty_grid
from bigs.train.plan.start_config import InitialConfig
from bigs.train.start.visual_hull import ObjectHull

HALF = np.array([0.03, 0.03, 0.02])
CONFIG = InitialConfig()


def seen_from_the_front(frames: int) -> ObjectHull:
    """A box before a camera that looks along +z; masks say nothing of its depth, points lie on its front."""
    grid = empty_grid(np.full(3, -0.06), np.full(3, 0.06), 48)
    corners = grid.points()
    # Silhouettes bound it sideways only.
    hull = np.abs(corners[:, :2]).max(1) - HALF[0]
    side = np.linspace(-1.0, 1.0, 12)
    x, y = (HALF[0] * values.ravel() for values in np.meshgrid(side, side))
    # A little depth behind the front, as points on the rim have it.
    z = np.where(np.maximum(np.abs(x), np.abs(y)) > 0.99 * HALF[0], 0.0, -HALF[2])
    views = ObjectViews(
        np.ones((frames, 8, 8), dtype=bool),
        np.array([[10.0, 0.0, 4.0], [0.0, 10.0, 4.0], [0.0, 0.0, 1.0]]),
        np.repeat(np.eye(3)[None], frames, axis=0),
        np.tile([0.0, 0.0, 0.7], (frames, 1)),
    )
    points = np.stack([x, y, z], axis=-1)
    return ObjectHull(
        DistanceGrid(hull.reshape(grid.values.shape), grid.origin, grid.spacing),
        (hull < 0.0).astype(float),
        points,
        np.tile([0.0, 0.0, -1.0], (len(points), 1)),
        views,
    )


@pytest.mark.parametrize("frames", [1, 5])
def test_it_is_closed_behind_its_points_and_not_before_them(frames: int) -> None:
    hull = seen_from_the_front(frames)
    surface = hull.closed(CONFIG, hull.points, hull.normals, CONFIG.surface_reach)
    axis = np.zeros((2, 3))
    axis[:, 2] = [-HALF[2] - 0.006, 0.012]
    index = np.round((axis - surface.origin) / surface.spacing).astype(int)
    before, behind = surface.values[tuple(index.T)]
    assert before > 0.0, "space that would hide the points is part of the object"
    assert behind < 0.0, "nothing is left behind the points"


def test_without_allowance_it_ends_at_the_points_hull() -> None:
    hull = seen_from_the_front(5)
    surface = hull.closed(CONFIG, hull.points, hull.normals, 0.0)
    inside = surface.points()[surface.values.ravel() < 0.0]
    assert convex_distance(inside, hull.points).max() <= CONFIG.surface_margin

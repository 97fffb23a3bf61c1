"""The object's surface at the start where only one side of it was ever looked at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.spatial
import skimage.draw
from scipy.spatial.transform import Rotation

from bigs.fused.shape import border_distances
from bigs.geometry.coverage import ObjectViews
from bigs.geometry.surface import (
    DistanceGrid,
    VisualHull,
    convex_distance,
    empty_grid,
)
from bigs.geometry.symmetry import Symmetry
from bigs.train.plan.start_config import InitialConfig
from bigs.train.start.far_side import far_side_depth
from bigs.train.start.visual_hull import ObjectHull

HALF = np.array([0.03, 0.03, 0.02])
CORNERS = HALF * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
K = np.array([[900.0, 0.0, 80.0], [0.0, 900.0, 80.0], [0.0, 0.0, 1.0]])
CONFIG = InitialConfig()


def turning_box(most: float, deep: float = 0.0) -> ObjectHull:
    """A box that turns by up to `most` degrees either way about y before the camera.

    Points lie on the side that it shows, and on its rim so many metres deep.
    """
    turns = np.linspace(-most, most, 9)
    rotations = Rotation.from_euler("y", turns[:, None], degrees=True).as_matrix()
    centers = np.tile([0.0, 0.0, 0.7], (len(turns), 1))
    masks = np.zeros((len(turns), 160, 160), dtype=bool)
    for mask, rotation, center in zip(masks, rotations, centers, strict=True):
        cam = CORNERS @ rotation.T + center
        pixels = cam[:, :2] / cam[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2] - 0.5
        outline = pixels[scipy.spatial.ConvexHull(pixels).vertices]
        mask[skimage.draw.polygon(outline[:, 1], outline[:, 0], mask.shape)] = True
    grid = empty_grid(np.full(3, -0.08), np.full(3, 0.08), 64)
    silhouettes = np.stack([border_distances(mask) for mask in masks])
    hull = VisualHull(silhouettes, K, rotations, centers).distance(grid.points())
    side = np.linspace(-1.0, 1.0, 12)
    x, y = (HALF[0] * values.ravel() for values in np.meshgrid(side, side))
    rim = np.maximum(np.abs(x), np.abs(y)) > 0.99 * HALF[0]
    points = np.stack([x, y, np.where(rim, deep - HALF[2], -HALF[2])], axis=-1)
    return ObjectHull(
        DistanceGrid(hull.reshape(grid.values.shape), grid.origin, grid.spacing),
        points,
        np.tile([0.0, 0.0, -1.0], (len(points), 1)),
        ObjectViews(masks, K, rotations, centers),
    )


def depths(surface: DistanceGrid) -> np.ndarray:
    """The least and the greatest z [2] inside the surface on the line through the object's middle."""
    middle = np.round((np.zeros(2) - surface.origin[:2]) / surface.spacing).astype(int)
    inside = np.flatnonzero(surface.values[middle[0], middle[1]] < 0.0)
    return surface.origin[2] + surface.spacing * inside[[0, -1]]


def test_the_far_side_lies_where_outlines_end() -> None:
    box = turning_box(25.0, deep=0.004)
    front, back = depths(box.closed(CONFIG, box.points, box.normals).grid)
    assert front > -HALF[2] - 0.004, "space that would hide the points is part of the object"
    assert back == pytest.approx(HALF[2], abs=0.006)


def test_a_stray_point_does_not_stretch_it() -> None:
    box = turning_box(25.0, deep=0.004)
    points = np.concatenate([box.points, [[0.02, 0.0, 0.05]]])
    normals = np.concatenate([box.normals, [[0.0, 0.0, 1.0]]])
    alone, beside = (
        depths(box.closed(CONFIG, *cloud).grid) for cloud in ((box.points, box.normals), (points, normals))
    )
    np.testing.assert_allclose(beside, alone, atol=box.grid.spacing + 1e-9)


def test_at_a_high_price_it_ends_at_the_points() -> None:
    box = turning_box(25.0, deep=0.004)
    back = depths(box.closed(replace(CONFIG, surface_price=1.0), box.points, box.normals).grid)[1]
    assert back < 0.004 - HALF[2] + CONFIG.surface_margin + box.grid.spacing


def test_the_hull_alone_is_deeper() -> None:
    assert depths(turning_box(25.0).grid)[1] > HALF[2] + 0.02


def test_where_outlines_ask_for_nothing_it_ends_at_the_points_hull() -> None:
    box = turning_box(25.0, deep=2.0 * HALF[2])
    surface = box.closed(CONFIG, box.points, box.normals).grid
    inside = surface.points()[surface.values.ravel() < 0.0]
    assert convex_distance(inside, box.points).max() <= CONFIG.surface_margin + surface.spacing


def test_cameras_looked_at_what_a_mirror_makes_of_a_side() -> None:
    box = turning_box(25.0, deep=0.004)
    near = Symmetry("plane", np.array([0.0, 0.0, 0.004 - HALF[2]]), np.array([0.0, 0.0, 1.0]))
    across = Symmetry("plane", np.zeros(3), np.array([1.0, 0.0, 0.0]))
    backs = [
        depths(box.closed(CONFIG, box.points, box.normals, symmetries).grid)[1]
        for symmetries in ([], [across], [near], [across, near])
    ]
    # Only the first shows the back, wherever it puts it.
    assert backs[0] == backs[1] > backs[2] + 0.015
    assert backs[3] == backs[2]


def test_depth_is_what_explains_most_for_its_price() -> None:
    box = turning_box(25.0)
    places = box.grid.points()[box.grid.values.ravel() < 0.0]
    beyond = places[:, 2] + HALF[2]

    def depth(price: float) -> float:
        return far_side_depth(box.views, places, beyond, box.grid.spacing, price)

    assert depth(CONFIG.surface_price) == pytest.approx(2.0 * HALF[2], abs=0.005)
    assert depth(1.0) == 0.0
    assert depth(0.0) >= depth(CONFIG.surface_price)
    # Nothing is explained by what no picture shows.
    nowhere = ObjectViews(np.zeros_like(box.views.shown), K, box.views.rotations, box.views.centers)
    assert far_side_depth(nowhere, places, beyond, box.grid.spacing, 0.006) == 0.0

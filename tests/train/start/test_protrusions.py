"""A part that masks show and no point lies on belongs to the object's start surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.spatial
import skimage.draw
import trimesh
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from bigs.fused.shape import border_distances
from bigs.geometry.coverage import ObjectViews
from bigs.geometry.mesh import sample_surface
from bigs.geometry.surface import DistanceGrid, VisualHull, empty_grid
from bigs.train.plan.start_config import InitialConfig
from bigs.train.start.protrusions import protruding
from bigs.train.start.visual_hull import ObjectHull

FRAMES = 24
K = np.array([[700.0, 0.0, 80.0], [0.0, 700.0, 80.0], [0.0, 0.0, 1.0]])
BODY = trimesh.creation.box((0.05, 0.06, 0.05))


def bar() -> trimesh.Trimesh:
    """Stands out from the body's side, not joined to it, and without a point on it."""
    place = trimesh.transformations.translation_matrix([0.051, 0.0, 0.0])
    return trimesh.creation.box((0.038, 0.008, 0.008), place)


def turning(with_bar: range) -> ObjectHull:
    """The body turns once before the camera; the bar shows in some frames."""
    turns = np.linspace(0.0, 360.0, FRAMES, endpoint=False)
    rotations = Rotation.from_euler("y", turns[:, None], degrees=True).as_matrix()
    centers = np.tile([0.0, 0.0, 0.7], (FRAMES, 1))
    masks = np.zeros((FRAMES, 160, 160), dtype=bool)
    for t, mask in enumerate(masks):
        for part in (BODY, bar()) if t in with_bar else (BODY,):
            cam = part.vertices @ rotations[t].T + centers[t]
            pixels = cam[:, :2] / cam[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2] - 0.5
            outline = pixels[scipy.spatial.ConvexHull(pixels).vertices]
            mask[skimage.draw.polygon(outline[:, 1], outline[:, 0], mask.shape)] = True
    grid = empty_grid(np.full(3, -0.08), np.full(3, 0.08), 64)
    # Where the bar is missing something hides it, so that the hull has it all the same.
    allowed = masks.copy()
    allowed[[t for t in range(FRAMES) if t not in with_bar]] = True
    hull = VisualHull(np.stack([border_distances(mask) for mask in allowed]), K, rotations, centers)
    points, normals = sample_surface(np.asarray(BODY.vertices), np.asarray(BODY.faces), 600)
    distance = hull.distance(grid.points()).reshape(grid.values.shape)
    return ObjectHull(
        DistanceGrid(distance, grid.origin, grid.spacing),
        points,
        normals,
        ObjectViews(masks, K, rotations, centers),
    )


def reach(hull: ObjectHull) -> float:
    """The largest x of the start surface, metres."""
    verts, _ = hull.closed(InitialConfig(), hull.points, hull.normals).mesh()
    return float(verts[:, 0].max())


def test_what_masks_show_beside_the_points_stays() -> None:
    assert reach(turning(range(FRAMES))) == pytest.approx(0.07, abs=0.006)


@pytest.mark.parametrize("frames", [0, 2])
def test_few_frames_are_no_evidence(frames: int) -> None:
    assert reach(turning(range(5, 5 + frames))) < 0.025 + 0.006


def test_without_such_a_part_points_alone_hold_the_surface() -> None:
    hull = turning(range(0))
    np.testing.assert_array_equal(
        hull.closed(InitialConfig(), hull.points, hull.normals).held_at, hull.points
    )


def test_what_shows_beside_is_told_from_what_lies_before() -> None:
    """The bar's end is asked for; places before and behind the body show nothing of their own."""
    hull = turning(range(FRAMES))
    solid = hull.grid.points()[(np.abs(hull.grid.points()) < [0.025, 0.03, 0.025]).all(1)]
    places = np.array([[0.06, 0.0, 0.0], [0.0, 0.0, 0.03], [0.03, 0.0, 0.0], [0.0, 0.0, 0.3]])
    found = protruding(hull.views, places, solid, hull.grid.spacing)
    assert found.tolist() == [True, False, False, False]
    assert not protruding(hull.views, places, solid[:0], hull.grid.spacing).any()
    assert protruding(hull.views, places[:0], solid, hull.grid.spacing).shape == (0,)


def still(shown: np.ndarray) -> ObjectViews:
    """Three frames of a mask [H, W] and one pose."""
    return ObjectViews(
        np.repeat(shown[None], 3, axis=0),
        K,
        np.repeat(np.eye(3)[None], 3, axis=0),
        np.tile([0.0, 0.0, 0.7], (3, 1)),
    )


def test_a_frame_that_does_not_show_the_known_part_says_nothing() -> None:
    """Its pose puts that part beside the mask or out of the picture, or there is no mask."""
    mask = turning(range(0)).views.shown[0]
    place = np.zeros((1, 3))
    for shown, x in ((mask, 0.075), (mask, 5.0), (np.zeros_like(mask), 0.0)):
        assert not protruding(still(shown), place, np.array([[x, 0.0, 0.0]]), 0.0025).any()


def test_a_coarse_grid_has_no_holes() -> None:
    steps = 0.008 * np.arange(-3, 4)
    solid = np.stack(np.meshgrid(steps, steps, [0.0]), axis=-1).reshape(-1, 3)
    views = still(turning(range(0)).views.shown[0])
    assert not protruding(views, np.array([[0.004, 0.004, 0.0]]), solid, 0.008).any()


def test_outlines_that_are_off_ask_for_nothing() -> None:
    hull = turning(range(0))
    rough = np.stack([binary_dilation(mask, iterations=5) for mask in hull.views.shown])
    views = replace(hull.views, shown=rough)
    outside = VisualHull(np.stack([border_distances(mask) for mask in rough]), *views.poses)
    distance = outside.distance(hull.grid.points()).reshape(hull.grid.values.shape)
    hull = replace(hull, grid=replace(hull.grid, values=distance), views=views)
    assert len(hull.closed(InitialConfig(), hull.points, hull.normals).held_at) == len(hull.points)


def test_a_part_shows_beside_a_body_that_a_hand_hides() -> None:
    """Its mask is not the body's, and what lies out of the picture is in no mask."""
    body = np.array([[x, y, 0.0] for x in np.arange(-20, 1) / 1000 for y in np.arange(-20, 21) / 1000])
    mask = np.zeros((160, 160), dtype=bool)
    mask[:, 82:120] = True  # right of the body, which ends at column 80
    places = np.array([[0.02, 0.0, 0.0], [0.0025, 0.0, 0.0]])
    assert protruding(still(mask), places, body, 0.001).tolist() == [True, False]
    outside = np.array([[5.0, 0.0, 0.0]])
    assert not protruding(still(np.ones_like(mask)), outside, body, 0.001).any()

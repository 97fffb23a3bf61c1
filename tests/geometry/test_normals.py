"""Normals of points, and their outer side: on a ball, on a thin plate, and on a front behind a ball."""

import numpy as np
import scipy.ndimage
from scipy.spatial.transform import Rotation

from bigs.fused.shape import border_distances
from bigs.geometry.coverage import ObjectViews, sphere_directions
from bigs.geometry.normals import outward_normals, point_normals, turned_alike
from bigs.geometry.surface import VisualHull

RADIUS = 0.05


def test_point_normals_follow_the_surface_and_the_given_side() -> None:
    directions = sphere_directions(500)
    # Only the side is taken from the given directions: these are 60 degrees off.
    tilted = directions + 1.7 * np.cross(directions, [0.0, 0.6, 0.8])
    normals = point_normals(RADIUS * directions, tilted)
    assert (normals * directions).sum(-1).min() > 0.99
    np.testing.assert_allclose(point_normals(RADIUS * directions, -tilted), -normals)


def test_neighbours_turn_normals_whose_own_evidence_is_wrong() -> None:
    rng = np.random.default_rng(0)
    directions = sphere_directions(600)
    signs = rng.choice([-1.0, 1.0], 600)
    normals = signs[:, None] * directions
    # A quarter of it is wrong.
    evidence = signs * np.where(rng.random(600) < 0.25, -1.0, 1.0)
    turned = turned_alike(RADIUS * directions, normals, evidence)
    assert ((turned * directions).sum(-1) > 0.0).mean() > 0.99


def test_the_walls_of_a_thin_plate_keep_their_own_sides() -> None:
    rng = np.random.default_rng(0)
    points = np.stack([*rng.uniform(-0.03, 0.03, (2, 800)), np.repeat([0.002, -0.002], 400)], axis=-1)
    outward = np.sign(points[:, 2:]) * np.array([0.0, 0.0, 1.0])
    wrong = rng.random(800) < 0.2
    turned = turned_alike(points, outward, np.where(wrong, -1.0, 1.0))
    assert ((turned * outward).sum(-1) > 0.0).mean() > 0.97


def test_sightings_decide_where_silhouettes_say_nothing() -> None:
    rng = np.random.default_rng(0)
    K = np.array([[400.0, 0, 120.0], [0, 400.0, 120.0], [0, 0, 1]])
    # A flat front, and a ball on a stalk before it, so that the middle of all points lies before the front.
    front = np.stack([*rng.uniform(-0.05, 0.05, (2, 1200)), np.zeros(1200)], axis=-1)
    ball = 0.008 * sphere_directions(1500)
    points = np.concatenate([front, ball - np.array([0.0, 0.0, 0.08])])
    rotations = Rotation.from_euler("yx", rng.uniform(-25.0, 25.0, (30, 2)), degrees=True).as_matrix()
    centers = np.tile([0.0, 0.0, 0.5], (30, 1))
    # The object fills every picture.
    shown = np.ones((30, 240, 240), dtype=bool)
    views = ObjectViews(shown, K, rotations, centers)
    hull = VisualHull(np.stack([border_distances(mask) for mask in shown]), K, rotations, centers, 3)
    found = outward_normals(points, hull, views, 0.002, 0.006)
    # Towards the cameras, although the middle of the points says otherwise.
    assert (found[:1200, 2] < 0.0).mean() > 0.98


def test_rough_outlines_do_not_turn_normals() -> None:
    rng = np.random.default_rng(0)
    K = np.array([[400.0, 0, 120.0], [0, 400.0, 120.0], [0, 0, 1]])
    directions = sphere_directions(1500)
    rotations = Rotation.random(40, random_state=0).as_matrix()
    centers = np.tile([0.0, 0.0, 0.5], (40, 1))
    rows, columns = np.mgrid[:240, :240] + 0.5
    inside = 400.0 * RADIUS / 0.5 - np.hypot(columns - 120.0, rows - 120.0)
    noise = [scipy.ndimage.zoom(rng.uniform(-3.0, 3.0, (21, 21)), 240 / 21, order=1) for _ in range(40)]
    masks = inside + np.stack(noise) > 0.0
    views = ObjectViews(masks, K, rotations, centers)
    hull = VisualHull(np.stack([border_distances(mask) for mask in masks]), K, rotations, centers, 3)
    found = outward_normals(RADIUS * directions, hull, views, 0.002, 0.006)
    assert ((found * directions).sum(-1) > 0.0).mean() > 0.995

"""Procedural rigid objects: a signed distance, a printed solid texture, and where hands hold them. Metres.

Every object stands along its z axis with the origin inside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
import skimage.measure
import trimesh

from bigs.data.synthetic.texture import card_print, label_print, rubber_and_paint
from bigs.types import Side

ObjectKind = Literal["bottle", "box", "tool"]
OBJECT_KINDS: tuple[ObjectKind, ...] = ("bottle", "box", "tool")

PointFunction = Callable[[np.ndarray], np.ndarray]

# Cell size of the grid from which the mesh is cut: finer than the smallest rounding (3 mm).
_MESH_CELL = 0.0025


@dataclass(frozen=True)
class HandPlace:
    """Where a hand holds the object, in the object's frame."""

    point: tuple[float, float, float]  # the palm is pressed to the surface along a line through this point
    normal: tuple[float, float, float]  # from the object to the palm
    thumb: tuple[float, float, float]  # where the thumb's side of the palm points; orthogonal to normal


@dataclass(frozen=True)
class SolidObject:
    """An object that hands can close on and rays can hit."""

    distance: PointFunction  # [N, 3] -> [N] metres to the surface, negative inside; accurate near it
    albedo: PointFunction  # [N, 3] -> [N, 3] colours in [0, 1]
    mesh: trimesh.Trimesh  # the zero level set, with vertex colours
    normals: np.ndarray  # [V, 3] of the mesh
    places: dict[Side, HandPlace]


def make_object(kind: ObjectKind) -> SolidObject:
    """The object of that name."""
    distance, albedo, half, places = _RECIPES[kind]
    verts, faces = _cut_mesh(distance, np.array(half) + 4 * _MESH_CELL)
    colors = (albedo(verts) * 255).round().astype(np.uint8)
    mesh = trimesh.Trimesh(verts, faces, vertex_colors=colors, process=False)
    return SolidObject(distance, albedo, mesh, surface_normals(distance, verts), places)


def surface_normals(distance: PointFunction, points: np.ndarray) -> np.ndarray:
    """Unit gradient [N, 3] of a distance by central differences."""
    step = 5e-4
    sides = [distance(points + offset) - distance(points - offset) for offset in step * np.eye(3)]
    gradient = np.stack(sides, axis=1)
    return gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-9)


def _cut_mesh(distance: PointFunction, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    axes = [np.arange(-h, h + _MESH_CELL, _MESH_CELL) for h in half]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = distance(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    verts, faces, _, _ = skimage.measure.marching_cubes(values, 0.0, spacing=(_MESH_CELL,) * 3)
    return verts + grid[0, 0, 0], faces


def _rounded_box(points: np.ndarray, center: np.ndarray, half: np.ndarray, radius: float) -> np.ndarray:
    q = np.abs(points - center) - (half - radius)
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0) - radius


def _revolved(radius: np.ndarray, z: np.ndarray, profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [N] to the solid whose radius over height is the polyline `profile` [K, 2], and its slope.

    The slope [N, 2] is the unit gradient over (radius, z).
    """
    best = np.full(len(radius), np.inf)
    away_r, away_z = np.zeros_like(best), np.zeros_like(best)
    for (from_r, from_z), (to_r, to_z) in pairwise(profile):
        dr, dz = to_r - from_r, to_z - from_z
        share = (((radius - from_r) * dr + (z - from_z) * dz) / (dr * dr + dz * dz)).clip(0.0, 1.0)
        r, h = radius - (from_r + share * dr), z - (from_z + share * dz)
        squared = r * r + h * h
        nearer = squared < best
        for found, value in ((best, squared), (away_r, r), (away_z, h)):
            np.copyto(found, value, where=nearer)
    best = np.sqrt(best)
    widest = np.interp(z, profile[1:-1, 1], profile[1:-1, 0])
    inside = (radius < widest) & (z > profile[0, 1]) & (z < profile[-1, 1])
    sign = np.where(inside, -1.0, 1.0)
    slope = (sign / np.maximum(best, 1e-9))[:, None] * np.stack([away_r, away_z], axis=1)
    return sign * best, slope


BOX_HALF = np.array([0.037, 0.026, 0.094])


def _box_distance(points: np.ndarray) -> np.ndarray:
    return _rounded_box(points, np.zeros(3), BOX_HALF, 0.003)


# (radius, height): foot, body, shoulder, neck, cap.
_BOTTLE_PROFILE = np.array(
    [
        [0.0, -0.105], [0.032, -0.105], [0.036, -0.099], [0.037, -0.03], [0.035, 0.01], [0.037, 0.04],
        [0.032, 0.06], [0.018, 0.072], [0.016, 0.08], [0.0205, 0.0805], [0.0195, 0.104], [0.0, 0.105],
    ]
)  # fmt: skip
# The bottle is oval, so that rotation about its axis also changes its outline.
_BOTTLE_OVAL = 0.78


def _bottle_distance(points: np.ndarray) -> np.ndarray:
    x, y, z = points[:, 0], points[:, 1] / _BOTTLE_OVAL, points[:, 2]
    radius = np.maximum(np.hypot(x, y), 1e-9)
    distance, slope = _revolved(radius, z, _BOTTLE_PROFILE)
    # Squeezing y makes the function steeper than a distance; dividing by its slope corrects that.
    steepness = np.hypot(slope[:, 0] * np.hypot(x, y / _BOTTLE_OVAL) / radius, slope[:, 1])
    return distance / np.maximum(steepness, 0.5)


_TOOL_PARTS = (  # centre, half size, rounding
    ((0.0, 0.0, -0.015), (0.019, 0.0165, 0.075), 0.012),  # grip
    ((0.022, 0.0, 0.066), (0.066, 0.024, 0.025), 0.012),  # body
    ((0.098, 0.0, 0.066), (0.022, 0.014, 0.014), 0.009),  # nose
    ((0.006, 0.0, -0.088), (0.036, 0.026, 0.013), 0.006),  # foot
)


def _tool_distance(points: np.ndarray) -> np.ndarray:
    parts = [_rounded_box(points, np.array(c), np.array(h), r) for c, h, r in _TOOL_PARTS]
    return np.minimum.reduce(parts)


_BESIDE: dict[Side, HandPlace] = {
    "right": HandPlace((0.0, 0.004, 0.038), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "left": HandPlace((0.0, 0.004, -0.048), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
}
_AT_TOOL: dict[Side, HandPlace] = {
    "right": HandPlace((0.0, 0.0, -0.02), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "left": HandPlace((0.045, 0.0, 0.066), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)),
}

_RECIPES: dict[
    str, tuple[PointFunction, PointFunction, tuple[float, float, float], dict[Side, HandPlace]]
] = {
    "box": (_box_distance, lambda p: card_print(p, BOX_HALF), tuple(BOX_HALF), _BESIDE),
    "bottle": (_bottle_distance, label_print, (0.037, 0.037, 0.105), _BESIDE),
    "tool": (_tool_distance, rubber_and_paint, (0.122, 0.03, 0.104), _AT_TOOL),
}

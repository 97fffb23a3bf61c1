"""Pictures and labels of the scene by casting rays at meshes: shares no code with the renderer under test."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh

from bigs.checks import InputError
from bigs.data.synthetic.objects import PointFunction

_LIGHT = np.array([-0.45, -0.75, -0.5]) / np.linalg.norm([-0.45, -0.75, -0.5])  # towards it, camera axes
_AMBIENT, _DIFFUSE = 0.56, 0.6
# Colour rays per pixel and axis; labels take one ray through the pixel's centre.
_SAMPLES = 2
_MARGIN = 2  # pixels around a body's box


@dataclass(frozen=True)
class Body:
    """One mesh as a frame shows it."""

    label: int  # its value in the mask
    verts: np.ndarray  # [V, 3] metres, camera frame
    faces: np.ndarray  # [F, 3]
    normals: np.ndarray  # [V, 3] unit, camera frame
    texture_points: np.ndarray  # [V, 3] where each vertex lies in the texture's own space
    texture: PointFunction  # [N, 3] points of that space -> [N, 3] colours


@dataclass(frozen=True)
class Picture:
    """The camera's image, labels and depth."""

    image: np.ndarray  # [H, W, 3] in [0, 1]
    mask: np.ndarray  # [H, W] uint8 labels of the nearest body, 0 where none
    depth: np.ndarray  # [H, W] metres along z at pixel centres, inf where there is none


def require_embree() -> type:
    """The class of Embree's ray casters, made from a mesh each.

    Raises:
        InputError: the package embreex is not installed.
    """
    try:
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError:
        raise InputError(
            "synthetic clips: expected the package embreex (pip install bigs[synthetic]), found none"
        ) from None
    return RayMeshIntersector


def take_picture(bodies: list[Body], K: np.ndarray, background: np.ndarray) -> Picture:
    """Cast one frame.

    Args:
        bodies: what is in the scene.
        K: [3, 3].
        background: [H, W, 3] in [0, 1].
    """
    height, width = background.shape[:2]
    center = _Rays(K, width, height, np.array([0.5]))
    fine = _Rays(K, width, height, (np.arange(_SAMPLES) + 0.5) / _SAMPLES)
    mask = np.zeros((height, width), dtype=np.uint8)
    color = np.repeat(np.repeat(background, _SAMPLES, axis=0), _SAMPLES, axis=1)
    for body in bodies:
        caster = require_embree()(trimesh.Trimesh(body.verts, body.faces, process=False))
        hit = center.nearer(body, caster)
        mask[hit.rows, hit.columns] = body.label
        hit = fine.nearer(body, caster)
        color[hit.rows, hit.columns] = _shade(body, hit)
    color = color.reshape(height, _SAMPLES, width, _SAMPLES, 3).mean(axis=(1, 3))
    return Picture(color, mask, center.depth)


@dataclass(frozen=True)
class _Hits:
    rows: np.ndarray  # [M] of the ray grid
    columns: np.ndarray  # [M]
    triangles: np.ndarray  # [M]
    weights: np.ndarray  # [M, 3] barycentric


class _Rays:
    """A grid of rays, one or several per pixel, and the depth of what each has met so far."""

    def __init__(self, K: np.ndarray, width: int, height: int, offsets: np.ndarray) -> None:
        self.K, self.per_pixel = K, len(offsets)
        u = (np.arange(width)[:, None] + offsets).ravel()
        v = (np.arange(height)[:, None] + offsets).ravel()
        x = (u - K[0, 2]) / K[0, 0]
        y = (v - K[1, 2]) / K[1, 1]
        self.directions = np.stack([*np.meshgrid(x, y), np.ones((len(v), len(u)))], axis=-1)
        self.depth = np.full((len(v), len(u)), np.inf)

    def nearer(self, body: Body, caster: Any) -> _Hits:
        """The rays that meet `body` before anything else so far; remembers their depth."""
        rows, columns = self._box(body.verts)
        directions = self.directions[rows, columns].reshape(-1, 3)
        triangles = caster.intersects_first(np.zeros_like(directions), directions)
        ray = np.flatnonzero(triangles >= 0)
        triangles, directions = triangles[ray], directions[ray]
        a, b, c = body.verts[body.faces[triangles]].transpose(1, 0, 2)
        # z d = a + s (b - a) + t (c - a) by Cramer's rule; z is the depth since directions have unit z.
        toward_b, toward_c = b - a, c - a
        normal = np.cross(toward_b, toward_c)
        facing = (directions * normal).sum(1)
        moment = np.cross(directions, a)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (a * normal).sum(1) / facing
            s, t = -(toward_c * moment).sum(1) / facing, (toward_b * moment).sum(1) / facing
        columns_per_row = columns.stop - columns.start
        row, column = rows.start + ray // columns_per_row, columns.start + ray % columns_per_row
        # A triangle seen exactly edge on has no depth and is invisible.
        front = (facing != 0) & (z < self.depth[row, column])
        row, column, z = row[front], column[front], z[front]
        self.depth[row, column] = z
        weights = np.clip(np.stack([1 - s - t, s, t], axis=1)[front], 0, 1)
        return _Hits(row, column, triangles[front], weights / weights.sum(axis=1, keepdims=True))

    def _box(self, verts: np.ndarray) -> tuple[slice, slice]:
        pixels = verts @ self.K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        low = np.floor(pixels.min(axis=0) - _MARGIN).astype(int) * self.per_pixel
        high = np.ceil(pixels.max(axis=0) + _MARGIN).astype(int) * self.per_pixel
        height, width = self.depth.shape
        (left, top), (right, bottom) = np.clip(low, 0, (width, height)), np.clip(high, 0, (width, height))
        return slice(top, bottom), slice(left, right)


def _shade(body: Body, hit: _Hits) -> np.ndarray:
    faces = body.faces[hit.triangles]
    normals = np.einsum("mk,mki->mi", hit.weights, body.normals[faces])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.einsum("mk,mki->mi", hit.weights, body.texture_points[faces])
    light = _AMBIENT + _DIFFUSE * np.maximum(0, normals @ _LIGHT)
    return np.clip(body.texture(points) * light[:, None], 0, 1)

"""An object of which one half is right and the other flat, and the exact prior of its pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from torch import Tensor

from bigs.geometry.mesh import frames_from_normals, sample_surface, vertex_normals
from bigs.geometry.rotations import matrix_to_quat
from bigs.guidance import Conditions
from bigs.guidance.cameras import Orbit, make_orbit, virtual_cameras
from bigs.models.canonical import CanonicalObject
from bigs.models.lighting import N_PARTS
from bigs.models.object_detail import ObjectDetail, split_object
from bigs.raster import RasterSettings
from bigs.train.loop.virtual_views import render_object

UP, FRONT = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0])


def texture(points: np.ndarray) -> np.ndarray:
    """Smooth stripes in three colours, [N, 3]."""
    waves = np.stack([np.sin(90.0 * points[:, axis] + axis) for axis in range(3)], axis=-1)
    return 0.5 + 0.35 * waves


def solid() -> trimesh.Trimesh:
    """A rounded body, longer than wide, 15 cm high."""
    ball = trimesh.creation.icosphere(3)
    verts = ball.vertices * [0.05, 0.04, 0.075] * (1.0 + 0.15 * np.sin(3.0 * ball.vertices[:, [2]]))
    return trimesh.Trimesh(verts, ball.faces, process=False)


def flattened(points: np.ndarray) -> np.ndarray:
    """What an object looks like whose back was never seen: it ends just behind the rim."""
    flat = points.copy()
    flat[:, 0] = np.where(points[:, 0] < 0, 0.15 * points[:, 0], points[:, 0])
    return flat


def gaussians(points: np.ndarray, normals: np.ndarray, colors: np.ndarray) -> CanonicalObject:
    """Flat Gaussians that cover a surface of some hundred square centimetres."""
    spacing = float(np.sqrt(0.04 / len(points)))
    as_tensor = lambda array: torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32)  # noqa: E731
    means = as_tensor(points)
    return CanonicalObject(
        means,
        torch.zeros_like(means),
        matrix_to_quat(as_tensor(frames_from_normals(normals))),
        torch.tensor([0.6, 0.6, 0.2]).mul(spacing).expand(len(means), 3).clone(),
        torch.full((len(means),), 0.95),
        as_tensor(colors),
        as_tensor(normals),
        torch.zeros(len(means), N_PARTS),
    )


@dataclass(frozen=True)
class HalfSeen:
    """The scene of the test."""

    truth: trimesh.Trimesh
    verts: np.ndarray  # [V, 3] of the half-seen object's mesh; faces are the truth's
    detail: ObjectDetail
    seen: Tensor  # [N] bool
    orbit: Orbit
    whole: CanonicalObject  # the true object


def half_seen(count: int = 900) -> HalfSeen:
    mesh = solid()
    points, normals = sample_surface(mesh.vertices, mesh.faces, count)
    whole = gaussians(points, normals, texture(points))
    # The back is grey as well as flat: nobody saw its colours.
    seen = points[:, 0] >= 0
    colors = np.where(seen[:, None], texture(points), 0.5)
    verts = flattened(mesh.vertices)
    flat_normals = vertex_normals(verts, mesh.faces)[
        ((points[:, None] - mesh.vertices) ** 2).sum(-1).argmin(1)
    ]
    normals = np.where(seen[:, None], normals, flat_normals)
    detail = split_object(gaussians(flattened(points), normals, colors), 1, 0.0)
    as_tensor = torch.as_tensor(np.asarray(mesh.vertices), dtype=torch.float32)
    return HalfSeen(mesh, verts, detail, torch.as_tensor(seen), make_orbit(as_tensor, UP, FRONT), whole)


class TrueRender:
    """The exact denoiser of pictures that are the true object's render from each view plus white noise."""

    detect_edges = None

    def __init__(self, scene: HalfSeen, size: int, spread: float = 0.05) -> None:
        self.scene, self.image_size, self.spread = scene, size, spread
        self.alphas_cumprod = torch.linspace(0.9999, 0.005, 1000)

    def encode(self, images: Tensor) -> Tensor:
        return 2.0 * images - 1.0

    def predict(self, noisy: Tensor, timesteps: Tensor, conditions: Conditions) -> Tensor:
        azimuths, elevations = conditions.azimuths[:, None], conditions.elevations[:, None]
        orbit = self.scene.orbit
        left = torch.linalg.cross(orbit.up, orbit.front)
        level = azimuths.cos() * orbit.front + azimuths.sin() * left
        directions = elevations.cos() * level + elevations.sin() * orbit.up
        cameras = virtual_cameras(orbit, directions, self.image_size)
        mean = self.encode(render_object(self.scene.whole, cameras, self.image_size, RasterSettings()))
        a = self.alphas_cumprod[timesteps][:, None, None, None]
        return (1 - a).sqrt() * (noisy - a.sqrt() * mean) / (a * self.spread**2 + 1 - a)

"""`bigs prior train`: a small prior from a folder of meshes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.spatial
import torch
import trimesh
from safetensors.torch import save
from torch import Tensor

from bigs.atomic import atomic_write
from bigs.checks import InputError, check_faces, check_finite, found_at
from bigs.commands.prior.fit import read_state, state_path
from bigs.data.entries import LARGEST
from bigs.data.mesh_files import MESH_SUFFIXES, load_mesh_file
from bigs.files import read_bytes
from bigs.geometry.arrays import float32
from bigs.geometry.coverage import sphere_directions
from bigs.geometry.mesh import frames_from_normals, point_spacing, sample_surface
from bigs.geometry.rotations import matrix_to_quat
from bigs.guidance.cameras import make_orbit, virtual_cameras
from bigs.guidance.denoiser import Conditions
from bigs.guidance.diffusers_folder import Device, choose
from bigs.guidance.pixel import PIXELS, PixelConfig, PixelDenoiser, PixelNet
from bigs.guidance.pixel_file import save_pixel_net
from bigs.guidance.pixel_training import Pictures, PixelTraining, PixelTrainingConfig
from bigs.guidance.residual import picture_residual
from bigs.models.canonical import CanonicalObject
from bigs.models.lighting import N_PARTS
from bigs.raster.settings import RasterSettings
from bigs.train.loop.virtual_views import render_object

__all__ = ["PixelConfig", "PixelTrainingConfig", "TrainedPrior", "train_prior"]

FORMAT = "bigs-pixel-state-1"
_GAUSSIANS = 3000
# Standard deviation of a Gaussian on the mesh: along the surface in spacings, and along the normal.
_SPREAD, _FLATNESS = 0.6, 0.35
# How well the network knows its meshes is measured on this many meshes in this many pictures each; this share
# is known at least so well.
_ASKED_MESHES, _ASKED_VIEWS, _ASKED_SHARE = 200, 8, 0.95


class TrainedPrior(NamedTuple):
    """The result of `train_prior`."""

    path: Path
    steps: int  # taken now
    loss: float  # mean over the last tenth of these
    meshes: int
    pictures: int
    parameters: int


def train_prior(
    meshes: Path,
    out: Path,
    config: PixelTrainingConfig,
    *,
    views: int = 32,
    up: str = "z",
    device: Device = "auto",
    resume: bool = False,
    keep_every: int = 500,
    listen: Callable[[dict[str, Any]], None] = lambda event: None,
) -> TrainedPrior:
    """Train a denoiser on renderings of meshes, and write it.

    While it works, what is needed to go on lies beside `out`; killed at any instant, it can be resumed and
    ends in the same bytes, on the same machine with as many threads.

    Args:
        meshes: folder of meshes; any size and unit, `up` along the named axis.
        out: the .safetensors file to write.
        config: the training.
        views: pictures of each mesh.
        up: "x", "y" or "z".
        device: where the network runs; pictures are made on the CPU.
        resume: go on from what lies beside `out`, if anything does.
        keep_every: steps between the states that are kept.
        listen: told what happens: "start", "step".

    Raises:
        InputError: something given is missing or does not fit; one sentence says what.
    """
    kept = state_path(out, resume)
    files = _mesh_files(meshes)
    training = PixelTraining(config, choose(device, "float32")[0])
    origin = _digest(files, config, views, up)
    if kept.exists():
        training.restore(*read_state(kept, FORMAT, origin, "these meshes and options"))
    parts = [mesh_pictures(file, views, up, config.seed + index) for index, file in enumerate(files)]
    pictures = Pictures(*(torch.cat(part) for part in zip(*parts, strict=True)))
    parameters = sum(p.numel() for p in training.net.parameters())
    weights_gib = sum(p.nbytes for p in training.net.parameters()) / 2.0**30
    listen({"event": "start", "weights_gib": weights_gib, "step": training.step})
    losses = []
    while training.step < config.steps:
        losses.append(training.take_step(pictures))
        listen({"event": "step", "step": training.step, "steps": config.steps, "loss": losses[-1]})
        if training.step % keep_every == 0:
            metadata = {"format": FORMAT, "origin": origin, "step": str(training.step)}
            with atomic_write(kept) as file:
                file.write(save(training.state(), metadata))
    save_pixel_net(out, training.mean.cpu(), familiar_residual(training.mean, parts))
    kept.unlink(missing_ok=True)
    last = losses[-max(1, len(losses) // 10) :]
    loss = sum(last) / len(last) if last else float("nan")
    return TrainedPrior(out, len(losses), loss, len(files), len(pictures.images), parameters)


def _mesh_files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of meshes, found {found_at(folder)}")
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in MESH_SUFFIXES)
    if not files:
        raise InputError(f"{folder}: expected meshes ({', '.join(MESH_SUFFIXES)}), found none")
    return files


def _digest(files: list[Path], config: PixelTrainingConfig, views: int, up: str) -> str:
    settings = json.dumps([asdict(config), views, up, [file.name for file in files]])
    digest = hashlib.sha256(settings.encode())
    for file in files:
        digest.update(read_bytes(file, "a triangle mesh"))
    return digest.hexdigest()[:16]


class Shape(NamedTuple):
    """A triangle mesh with a colour at each vertex."""

    verts: np.ndarray  # [V, 3] metres
    faces: np.ndarray  # [F, 3]
    colors: np.ndarray  # [V, 3] in [0, 1]


def read_shape(file: Path, up: str) -> Shape:
    """A mesh from a file, its axis `up` turned to z, as large as a ball of 10 cm radius holds.

    Raises:
        InputError: no triangle mesh.
    """
    mesh = load_mesh_file(file, "a triangle mesh", trimesh.load_mesh, materials=True)
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"{file}: expected a triangle mesh, found one without faces")
    verts = np.asarray(mesh.vertices, dtype=np.float64)
    check_finite(f"{file}: vertices", verts)
    check_faces(f"{file}: faces", mesh.faces, len(verts))
    verts = verts - 0.5 * (verts.min(0) + verts.max(0))
    radius = np.linalg.norm(verts, axis=-1).max()
    if not 0.0 < radius < LARGEST:
        raise InputError(f"{file}: vertices: expected a mesh with an extent, found a radius of {radius:.3g}")
    verts = 0.1 * verts / radius
    verts = np.roll(verts, 2 - "xyz".index(up), axis=-1)
    visual: Any = mesh.visual
    if isinstance(visual, trimesh.visual.TextureVisuals):
        visual = visual.to_color()
        visual.mesh = mesh  # counts a mesh's vertices if it has no texture
    return Shape(verts, np.asarray(mesh.faces), np.asarray(visual.vertex_colors)[:, :3] / 255.0)


def cover(shape: Shape) -> CanonicalObject:
    """A mesh covered with flat Gaussians."""
    points, normals = sample_surface(shape.verts, shape.faces, _GAUSSIANS)
    nearest = scipy.spatial.cKDTree(shape.verts).query(points)[1]
    spacing = point_spacing(points)
    scales = _SPREAD * spacing[:, None] * np.array([1.0, 1.0, _FLATNESS])
    means = float32(points)
    return CanonicalObject(
        means,
        torch.zeros_like(means),
        matrix_to_quat(float32(frames_from_normals(normals))),
        float32(scales),
        torch.full((len(means),), 0.95),
        float32(shape.colors[nearest]),
        float32(normals),
        torch.zeros(len(means), N_PARTS),  # nothing shades it
    )


def familiar_residual(net: PixelNet, parts: list[tuple[Tensor, Tensor, Tensor]]) -> float:
    """`Denoiser.familiar` of a network that has learned from these meshes' pictures (`mesh_pictures`)."""
    denoiser = PixelDenoiser(net.cpu())
    residuals = []
    for images, azimuths, elevations in parts[:: -(-len(parts) // _ASKED_MESHES)]:
        some = slice(None, None, -(-len(images) // _ASKED_VIEWS))
        asked = Conditions(azimuths[some], elevations[some])
        residuals.append(picture_residual(denoiser, images[some].float() / 255.0, asked))
    return float(np.quantile(residuals, _ASKED_SHARE))


def mesh_pictures(file: Path, views: int, up: str, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Pictures [views, 3, 64, 64] (uint8) of a mesh with their azimuths and elevations.

    The front is drawn for each mesh: in a reconstruction it is the side that the clip saw, whichever it is.
    """
    whole = cover(read_shape(file, up))
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    front = torch.tensor([np.cos(angle), np.sin(angle), 0.0], dtype=torch.float32)
    orbit = make_orbit(whole.means, torch.tensor([0.0, 0.0, 1.0]), front)
    turned = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    directions = torch.as_tensor(sphere_directions(views) @ turned.T, dtype=torch.float32)
    cameras = virtual_cameras(orbit, directions, PIXELS)
    with torch.no_grad():
        images = render_object(whole, cameras, PIXELS, RasterSettings())
    return (255.0 * images.clamp(0.0, 1.0)).round().to(torch.uint8), cameras.azimuths, cameras.elevations

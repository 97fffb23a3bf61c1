"""Train a small diffusion prior on a family of objects, and see what it knows of others of that family.

Key ideas:
- `bigs prior train` needs nothing but a folder of meshes; here they are generated.
- Of each held-out object the front half is right and the back is flat, as if a clip had never shown it. Score
  distillation moves the Gaussians of the back, and the mesh follows.
- What was seen gets no gradient. The score is taken on the half that was never seen.

Prints a table and writes it to `prior.md`; the prior itself goes to `prior.safetensors`. That takes a
quarter of an hour on one thread; `--prior FILE` scores a prior that is there already.

    python examples/train_prior.py --out OUT
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.spatial
import torch
import trimesh
import tyro
from rich.console import Console

from bigs.commands.prior.train import Shape, cover, read_shape, train_prior
from bigs.commands.progress import steps_listener
from bigs.commands.spoken import spoken
from bigs.geometry.mesh import frames_from_normals, sample_surface, vertex_normals
from bigs.geometry.rotations import matrix_to_quat
from bigs.guidance.cameras import make_orbit
from bigs.guidance.denoiser import Denoiser
from bigs.guidance.pixel import PixelConfig
from bigs.guidance.pixel_file import load_pixel_denoiser
from bigs.guidance.pixel_training import PixelTrainingConfig
from bigs.metrics.shape import ShapeScore, shape_score
from bigs.models.object_detail import split_object
from bigs.raster.settings import RasterSettings
from bigs.train.plan.config import GuidanceStage
from bigs.train.unseen.prior_descent import coverage_of, follow, guide_object

# Seeds of the objects to learn from begin at 0, those of the others here.
HELD_OUT = 10_000


class Found(NamedTuple):
    """One held-out object: the scores of its unseen half before the prior and after it."""

    name: str
    before: ShapeScore
    after: ShapeScore


def main(
    out: Path = Path("example_out"),
    prior: Path | None = None,
    learn_from: int = 120,
    held_out: int = 6,
    steps: int = 2000,
    width: int = 48,
    stage_steps: int = 300,
) -> list[Found]:
    """Train a prior, let it complete objects that it never saw, and print how much nearer they come.

    Args:
        out: folder for meshes, prior and table.
        prior: a file of bigs prior train; without it one is trained first.
        learn_from: objects to train on.
        held_out: objects to try.
        steps: of the training.
        width: of the network; 48 makes 0.7 million parameters.
        stage_steps: steps of score distillation on each object.
    """
    others = write_meshes(out / "held_out", held_out, HELD_OUT)
    if prior is None:
        write_meshes(out / "learn_from", learn_from, 0)
        prior = out / "prior.safetensors"
        config = PixelTrainingConfig(steps, batch=16, lr=1e-3, net=PixelConfig(width))
        with steps_listener(Console(stderr=True), "training the prior") as listen:
            train_prior(out / "learn_from", prior, config, listen=listen)
    denoiser = load_pixel_denoiser(prior)
    found = []
    with spoken(Console(stderr=True)) as lines:
        for number, file in enumerate(others, 1):
            lines.say(f"completing {file.name}, {number} of {len(others)}")
            found.append(completed(file, denoiser, stage_steps))
    text = "\n".join(table(found))
    (out / "prior.md").write_text(text + "\n")
    print(text)
    return found


def completed(file: Path, denoiser: Denoiser, steps: int) -> Found:
    """Flatten the back of an object, let a prior complete it, and score that half before and after."""
    truth = read_shape(file, "z")
    flat = Shape(flattened(truth.verts), truth.faces, truth.colors)
    whole = cover(truth)
    seen = whole.means[:, 0] >= 0.0
    # The back has a flat shape, the normals of that, and the colours of what is before it.
    points = whole.means.numpy().astype(np.float64)
    normals = vertex_normals(flat.verts, flat.faces)[scipy.spatial.cKDTree(truth.verts).query(points)[1]]
    normals = np.where(seen[:, None], whole.normals, normals)
    front = points[seen.numpy()] * [0, 1, 1]
    colors = whole.colors[seen][scipy.spatial.cKDTree(front).query(points * [0, 1, 1])[1]]
    as_tensor = lambda array: torch.as_tensor(array, dtype=torch.float32)  # noqa: E731
    half = whole._replace(
        means=as_tensor(flattened(points)),
        quats=matrix_to_quat(as_tensor(frames_from_normals(normals))),
        colors=torch.where(seen[:, None], whole.colors, colors),
        normals=as_tensor(normals),
    )
    done = guide_object(
        split_object(half, 1, 0.0),
        coverage_of(half.normals, seen),
        make_orbit(as_tensor(truth.verts), torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0])),
        denoiser,
        GuidanceStage(steps=steps),
        RasterSettings(),
        # There are no pictures of a clip here, so no guard over what they show.
        lambda: torch.ones(1),
    )
    moved = follow(as_tensor(flat.verts), half.means, done.moved).numpy()
    return Found(file.stem, unseen_score(flat.verts, truth), unseen_score(moved, truth))


def flattened(points: np.ndarray) -> np.ndarray:
    """What an object looks like whose back was never seen: it ends just behind the rim."""
    back = points[:, :1] < 0.0
    return np.where(back, points * [0.15, 1.0, 1.0], points)


def unseen_score(verts: np.ndarray, truth: Shape) -> ShapeScore:
    """Of the faces of the half that was never seen: of a mesh with vertices [V, 3] and of the true one."""
    back = truth.faces[(truth.verts[:, 0] < -0.002)[truth.faces].all(1)]
    return shape_score(sample_surface(verts, back, 3000)[0], sample_surface(truth.verts, back, 3000)[0])


def table(found: list[Found]) -> list[str]:
    """The scores as lines of Markdown."""
    rows = ["| object | CD_o, cm², flat | after the prior | F10, flat | after |", "|---|---|---|---|---|"]
    numbers = np.array(
        [(f.before.chamfer.squared, f.after.chamfer.squared, f.before.f10, f.after.f10) for f in found]
    )
    for name, row in zip([f.name for f in found] + ["mean"], [*numbers, numbers.mean(0)], strict=True):
        rows.append(f"| {name} | {row[0]:.2f} | {row[1]:.2f} | {row[2]:.1f} | {row[3]:.1f} |")
    return rows


def container(seed: int) -> trimesh.Trimesh:
    """A box, can, bottle or jug of random proportions and colours, 10 to 20 cm high, z up, centred."""
    rng = np.random.default_rng(seed)
    height, wide, deep = rng.uniform(0.1, 0.2), rng.uniform(0.05, 0.09), rng.uniform(0.03, 0.09)
    kind = seed % 3
    if kind == 0:
        mesh = trimesh.creation.box((wide, deep, height))
        mesh = mesh.subdivide().subdivide().subdivide().subdivide()
    else:
        shoulder, neck = (1.0, 1.0) if kind == 1 else (rng.uniform(0.55, 0.75), rng.uniform(0.25, 0.5))
        half = 0.5 * neck
        outline = np.array([[0, 0], [0.5, 0], [0.5, shoulder], [half, 0.5 + 0.5 * shoulder], [half, 1]])
        places = np.linspace(0, 1, 33)
        length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))]
        fine = np.stack([np.interp(places * length[-1], length, outline[:, i]) for i in range(2)], axis=-1)
        fine = np.concatenate([fine, [[0.0, 1.0]]])
        mesh = trimesh.creation.revolve(fine, sections=48)
        mesh.apply_scale([wide, deep if kind == 2 else wide, height])
    verts = np.asarray(mesh.vertices) - 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    level = (verts[:, 2] / height) + 0.5
    base, band = rng.uniform(0.15, 0.95, (2, 3))
    low, high = np.sort(rng.uniform(0.15, 0.8, 2))
    colors = np.where(((level > low) & (level < high))[:, None], band, base)
    colors = (255 * colors).round().astype(np.uint8)
    return trimesh.Trimesh(verts, mesh.faces, vertex_colors=colors, process=False)


def write_meshes(folder: Path, count: int, first_seed: int) -> list[Path]:
    """Write `count` containers as PLY files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{first_seed + index:06d}.ply" for index in range(count)]
    for index, path in enumerate(paths):
        container(first_seed + index).export(path)
    return paths


if __name__ == "__main__":
    tyro.cli(main)

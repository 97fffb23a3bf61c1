"""Train Gaussians with a script written for gsplat: only the import differs.

Key ideas:
- `bigs.raster.gsplat.rasterization` takes gsplat's arguments and returns what gsplat returns, on a CPU.
- `meta["means2d"].retain_grad()` gives densification its statistics: Gaussians that the loss pulls across the
  screen are too few, and are split in two.
- Colours are spherical harmonics, so they may depend on the direction of view.

The pictures are generated: a striped ball seen from a ring of cameras. Writes `views.png`: three of them
above what the Gaussians show from there.

    python examples/gsplat_script.py --out OUT
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
import tyro
from PIL import Image
from torch import Tensor

from bigs.raster.gsplat import rasterization  # was: from gsplat import rasterization

SH_DEGREE = 1


def main(
    out: Path = Path("example_out"),
    count: int = 300,
    steps: int = 200,
    size: int = 64,
    views: int = 8,
) -> tuple[float, float, int]:
    """Fit the ball; say how near the fit comes and how many Gaussians it took.

    Args:
        out: folder for the picture.
        count: Gaussians at the start.
        steps: of the optimiser.
        size: of the pictures, pixels.
        views: how many pictures.
    """
    torch.manual_seed(0)
    viewmats, Ks = ring_of_cameras(views, size)
    targets = striped_ball(viewmats, Ks, size)
    splats = random_start(count)
    optimizer = adam(splats)
    watched = torch.zeros(count)
    psnrs = []
    for step in range(steps):
        chosen = torch.randperm(views)[:2]
        colors, _, meta = render(splats, viewmats[chosen], Ks[chosen], size)
        meta["means2d"].retain_grad()
        loss = (colors - targets[chosen]).abs().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        # Per pixel, so in units of half the image: how hard the loss pulls at each Gaussian that is seen.
        pull = meta["means2d"].grad.norm(dim=-1) * 0.5 * size * meta["n_cameras"]
        watched.index_add_(0, meta["gaussian_ids"], pull)
        optimizer.step()
        if step % 50 == 49 and step + 1 < steps:
            splats = split(splats, watched > watched.quantile(0.8))
            optimizer = adam(splats)
            watched = torch.zeros(len(splats["means"]))
        if step % 50 == 49 or step == 0:
            with torch.no_grad():
                everything = render(splats, viewmats, Ks, size)[0]
            psnrs.append(float(-10 * (everything - targets).square().mean().log10()))
            print(f"step {step + 1:4d}   {len(splats['means']):5d} Gaussians   PSNR {psnrs[-1]:.2f} dB")

    out.mkdir(parents=True, exist_ok=True)
    with torch.no_grad():
        shown = render(splats, viewmats[:3], Ks[:3], size)[0]
    rows = torch.cat([torch.cat(list(images), dim=1) for images in (targets[:3], shown)])
    pixels = (255 * rows.clamp(0, 1)).round().to(torch.uint8).numpy()
    Image.fromarray(pixels).resize((3 * 3 * size, 2 * 3 * size), Image.Resampling.NEAREST).save(
        out / "views.png"
    )
    return psnrs[0], psnrs[-1], len(splats["means"])


def render(splats: dict[str, Tensor], viewmats: Tensor, Ks: Tensor, size: int) -> tuple[Tensor, Tensor, dict]:
    """The call as gsplat's own trainers write it."""
    return rasterization(
        means=splats["means"],
        quats=splats["quats"],
        scales=torch.exp(splats["scales"]),
        opacities=torch.sigmoid(splats["opacities"]),
        colors=torch.cat([splats["sh0"], splats["shN"]], dim=1),
        viewmats=viewmats,
        Ks=Ks,
        width=size,
        height=size,
        sh_degree=SH_DEGREE,
        packed=True,
        rasterize_mode="antialiased",
        absgrad=False,
        sparse_grad=False,
    )


def ring_of_cameras(views: int, size: int) -> tuple[Tensor, Tensor]:
    """World-to-camera matrices [C, 4, 4] and camera matrices [C, 3, 3], 3 m from the origin and facing it."""
    angle = torch.arange(views) * (2 * math.pi / views)
    viewmats = torch.eye(4).repeat(views, 1, 1)
    viewmats[:, 0, 0], viewmats[:, 0, 2] = angle.cos(), angle.sin()
    viewmats[:, 2, 0], viewmats[:, 2, 2] = -angle.sin(), angle.cos()
    viewmats[:, 2, 3] = 3.0
    K = torch.tensor([[1.2 * size, 0.0, size / 2], [0.0, 1.2 * size, size / 2], [0.0, 0.0, 1.0]])
    return viewmats, K.repeat(views, 1, 1)


def striped_ball(viewmats: Tensor, Ks: Tensor, size: int) -> Tensor:
    """What the cameras see, [C, H, W, 3]: a ball of radius 1 with stripes and a lamp above it."""
    row, column = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    pixels = torch.stack([column, row, torch.ones_like(row)], dim=-1)
    rays = torch.einsum("cij,hwj->chwi", torch.linalg.inv(Ks), pixels)
    rotations = viewmats[:, :3, :3]
    eyes = -torch.einsum("cji,cj->ci", rotations, viewmats[:, :3, 3])[:, None, None, :]
    rays = torch.nn.functional.normalize(torch.einsum("cji,chwj->chwi", rotations, rays), dim=-1)
    along = (rays * eyes).sum(-1)
    discriminant = along**2 - (eyes.square().sum(-1) - 1.0)
    points = eyes + (-along - discriminant.clamp_min(0).sqrt())[..., None] * rays
    x, y, z = points.unbind(-1)
    stripes = torch.sin(5 * torch.atan2(z, x) + 3 * y)[..., None] > 0
    paint = torch.where(stripes, torch.tensor([0.9, 0.35, 0.2]), torch.tensor([0.2, 0.45, 0.85]))
    light = (0.6 - 0.4 * y)[..., None]
    return torch.where((discriminant > 0)[..., None], paint * light, torch.zeros(3))


def random_start(count: int) -> dict[str, Tensor]:
    """Grey blobs all over a ball, by the names that gsplat's strategies use."""
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    values = {
        "means": 1.1 * directions * torch.rand(count, 1) ** (1 / 3),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        "scales": torch.full((count, 3), math.log(0.15)),
        "opacities": torch.full((count,), -1.0),
        "sh0": torch.zeros(count, 1, 3),
        "shN": torch.zeros(count, (SH_DEGREE + 1) ** 2 - 1, 3),
    }
    return {name: value.requires_grad_() for name, value in values.items()}


def adam(splats: dict[str, Tensor]) -> torch.optim.Optimizer:
    """One learning rate per kind of parameter."""
    rates = {"means": 0.01, "quats": 0.02, "scales": 0.02, "opacities": 0.05, "sh0": 0.05, "shN": 0.01}
    return torch.optim.Adam([{"params": splats[name], "lr": rate} for name, rate in rates.items()])


def split(splats: dict[str, Tensor], which: Tensor) -> dict[str, Tensor]:
    """Two smaller Gaussians in the place of each of these, drawn from it; the rest stay."""
    with torch.no_grad():
        halves = {name: value[which].repeat_interleave(2, dim=0) for name, value in splats.items()}
        halves["means"] += halves["scales"].exp() * torch.randn_like(halves["means"])
        halves["scales"] -= math.log(1.6)
        joined = {name: torch.cat([value[~which], halves[name]]) for name, value in splats.items()}
    return {name: value.clone().requires_grad_() for name, value in joined.items()}


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)

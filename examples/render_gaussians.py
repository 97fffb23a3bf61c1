"""Render 3D Gaussians with the rasteriser alone.

Key ideas:
- `bigs.raster.rasterization` takes plain tensors under gsplat's names: no clip, no hand, no training.
- A disc is a Gaussian whose third standard deviation is small; its quaternion (w x y z) turns z to the
  normal.
- One call serves several cameras, and depth comes with the colours when `render_mode` asks for it.

Writes `colors.png` (white behind the scene) and `depth.png` (near is bright), one column per camera.

    python examples/render_gaussians.py --out OUT
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
import tyro
from PIL import Image
from torch import Tensor

from bigs.geometry.rotations import matrix_to_quat
from bigs.raster import rasterization
from bigs.types import Gaussians


def main(out: Path = Path("example_out"), count: int = 10_000, width: int = 320, height: int = 320) -> None:
    """Render a knot of little discs from three sides.

    Args:
        out: folder for the pictures.
        count: how many discs.
        width: of a picture, pixels.
        height: of a picture, pixels.
    """
    knot = trefoil(count)
    viewmats = torch.stack([orbit(degrees, distance=3.8) for degrees in (0.0, 50.0, 100.0)])
    focal = 1.1 * width
    # The principal point is the image's middle: pixel (i, j) has its centre at (i + 0.5, j + 0.5).
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    images, alphas, info = rasterization(
        *knot,
        viewmats,
        K.expand(3, 3, 3),
        width,
        height,
        backgrounds=torch.ones(3, 3),
        render_mode="RGB+ED",
    )
    colors, depth = images[..., :3], images[..., 3:]
    # Expected depth means something only where there is something.
    seen = alphas > 0.5
    near, far = depth[seen].min(), depth[seen].max()
    nearness = torch.where(seen, 1.0 - 0.8 * (depth - near) / (far - near), torch.zeros_like(depth))

    out.mkdir(parents=True, exist_ok=True)
    side_by_side(colors).save(out / "colors.png")
    side_by_side(nearness.expand(-1, -1, -1, 3)).save(out / "depth.png")
    print(f"{count} Gaussians, {info['n_visible']} drawn over all cameras, pictures in {out}")


def trefoil(count: int, thickness: float = 0.28) -> Gaussians:
    """`count` discs, evenly spread, on a tube around a trefoil knot of about unit radius."""
    # A spiral that turns by the golden angle, at even steps of length: the same on a long tube as on
    # a short one. Random places, or even steps of the angle, would leave holes where the tube is stretched.
    angles = torch.linspace(0, 2 * math.pi, 4097)
    lengths = (_knot(angles[1:]) - _knot(angles[:-1])).norm(dim=-1).cumsum(0)
    index = torch.arange(count, dtype=torch.float64)
    wanted = ((index + 0.5) / count * lengths[-1]).float()
    along = angles[1:][torch.searchsorted(lengths, wanted).clamp(max=len(lengths) - 1)]
    around = (2 * math.pi * (index * 0.6180339887 % 1)).float()
    eps = 1e-3
    tangent = torch.nn.functional.normalize(_knot(along + eps) - _knot(along - eps), dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(tangent)
    side = torch.nn.functional.normalize(torch.linalg.cross(tangent, up), dim=-1)
    normal = around.cos()[:, None] * side + around.sin()[:, None] * torch.linalg.cross(side, tangent)
    frames = torch.stack([tangent, torch.linalg.cross(normal, tangent), normal], dim=-1)
    hue = 0.5 + 0.5 * torch.cos(along[:, None] + torch.tensor([0.0, 2.1, 4.2]))
    shade = 0.55 + 0.45 * normal[:, 2:]
    # Each disc has so much of the tube's surface to itself, more on the outside of a bend.
    sigma = 0.8 * math.sqrt(2 * math.pi * thickness * float(lengths[-1]) / count)
    return Gaussians(
        means=_knot(along) + thickness * normal,
        quats=matrix_to_quat(frames),
        scales=torch.tensor([sigma, sigma, 0.2 * sigma]).expand(count, 3),
        opacities=torch.full((count,), 0.9),
        colors=hue * shade,
    )


def _knot(t: Tensor) -> Tensor:
    """The knot's centre line [N, 3] at angles [N]."""
    curve = [t.sin() + 2 * (2 * t).sin(), t.cos() - 2 * (2 * t).cos(), -(3 * t).sin()]
    return torch.stack(curve, dim=-1) / 2.5


def orbit(degrees: float, distance: float) -> Tensor:
    """World-to-camera matrix [4, 4] (OpenCV axes) of a camera that circles the origin and looks at it."""
    angle = math.radians(degrees)
    viewmat = torch.eye(4)
    viewmat[0, 0], viewmat[0, 2] = math.cos(angle), math.sin(angle)
    viewmat[2, 0], viewmat[2, 2] = math.sin(angle), -math.cos(angle)
    # A rotation, not a reflection: y of the world is up, y of the camera is down.
    viewmat[1, 1] = -1.0
    viewmat[2, 3] = distance
    return viewmat


def side_by_side(images: Tensor) -> Image.Image:
    """Images [C, H, W, 3] in [0, 1] as one picture, from left to right."""
    row = torch.cat(list(images), dim=1)
    return Image.fromarray((255 * row.clamp(0, 1)).round().to(torch.uint8).numpy())


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)

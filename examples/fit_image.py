"""Fit Gaussians to a picture by gradient descent through the rasteriser.

Key ideas:
- `rasterization` is an ordinary differentiable torch function: any torch optimiser and any loss work.
- Train what has no limits: logarithms of scales, logits of opacities and colours. Activate them for the call.
- Gaussians that lie in a plane in front of the camera make a two-dimensional picture.

The picture is generated. Writes `fit.png`: the picture, the fit at the start and the fit at the end.

    python examples/fit_image.py --out OUT
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
import tyro
from PIL import Image
from torch import Tensor

from bigs.metrics.image import psnr
from bigs.raster import rasterization
from bigs.types import Gaussians


def main(
    out: Path = Path("example_out"),
    count: int = 500,
    steps: int = 200,
    width: int = 128,
    height: int = 96,
) -> tuple[float, float]:
    """Fit a picture and say how near the fit comes.

    Args:
        out: folder for the picture.
        count: how many Gaussians.
        steps: of the optimiser.
        width: of the picture, pixels.
        height: of the picture, pixels.
    """
    torch.manual_seed(0)
    target = picture(width, height)
    parameters = random_start(count, width, height)
    optimizer = torch.optim.Adam(
        [
            {"params": parameters["means"], "lr": 0.5 / width},
            {"params": parameters["log_scales"], "lr": 0.03},
            {"params": parameters["quats"], "lr": 0.03},
            {"params": parameters["opacity_logits"], "lr": 0.03},
            {"params": parameters["color_logits"], "lr": 0.05},
        ]
    )
    with torch.no_grad():
        start = render(parameters, width, height)
    for step in range(steps):
        loss = (render(parameters, width, height) - target).square().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if (step + 1) % 50 == 0:
            print(f"step {step + 1:4d}   PSNR {-10 * math.log10(float(loss.detach())):.2f} dB")
    with torch.no_grad():
        end = render(parameters, width, height)

    out.mkdir(parents=True, exist_ok=True)
    row = torch.cat([target, start, end], dim=1)
    pixels = (255 * row.clamp(0, 1)).round().to(torch.uint8).numpy()
    Image.fromarray(pixels).resize((9 * width, 3 * height), Image.Resampling.NEAREST).save(out / "fit.png")
    before, after = (float(psnr(_batch(image), _batch(target))) for image in (start, end))
    print(f"PSNR {before:.2f} dB at the start, {after:.2f} dB at the end, picture in {out / 'fit.png'}")
    return before, after


def picture(width: int, height: int) -> Tensor:
    """A sunset over stripes of water, [H, W, 3] in [0, 1]: smooth parts, edges and fine lines."""
    x = (torch.arange(width) + 0.5) / height
    y = (torch.arange(height) + 0.5)[:, None] / height
    sky = torch.stack([0.95 - 0.5 * (1 - y), 0.45 + 0.25 * (1 - y), 0.3 + 0.6 * (1 - y)], dim=-1)
    waves = 0.5 + 0.5 * torch.sin(60 * y**2 + 2 * torch.sin(9 * x))
    water = waves[..., None] * torch.tensor([0.35, 0.45, 0.65]) + torch.tensor([0.05, 0.1, 0.2])
    sun = ((x - 0.66) ** 2 + (y - 0.45) ** 2 < 0.24**2)[..., None]
    scene = torch.where(sun, torch.tensor([1.0, 0.85, 0.4]), sky.expand(height, width, 3))
    return torch.where((y > 0.6)[..., None], water, scene)


def random_start(count: int, width: int, height: int) -> dict[str, Tensor]:
    """Grey round blobs all over the picture, as tensors to train."""
    aspect = width / height
    means = torch.rand(count, 2) * torch.tensor([aspect, 1.0])
    values = {
        "means": means,
        "log_scales": torch.full((count, 2), math.log(0.5 * math.sqrt(aspect / count))),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        "opacity_logits": torch.zeros(count),
        "color_logits": 0.1 * torch.randn(count, 3),
    }
    return {name: value.requires_grad_() for name, value in values.items()}


def render(parameters: dict[str, Tensor], width: int, height: int) -> Tensor:
    """The picture [H, W, 3] that the parameters make: Gaussians in the plane z = 1, one unit per height."""
    flat = torch.ones_like(parameters["means"][:, :1])
    gaussians = Gaussians(
        # The order in depth decides which covers which; a small fixed tilt keeps it the same in every step.
        means=torch.cat([parameters["means"], 1 + 1e-4 * torch.linspace(0, 1, len(flat))[:, None]], dim=-1),
        # Only the turn about the viewing axis is free.
        quats=parameters["quats"] * torch.tensor([1.0, 0.0, 0.0, 1.0]),
        scales=torch.cat([parameters["log_scales"].exp(), 1e-3 * flat], dim=-1),
        opacities=parameters["opacity_logits"].sigmoid(),
        colors=parameters["color_logits"].sigmoid(),
    )
    K = torch.tensor([[float(height), 0.0, 0.0], [0.0, float(height), 0.0], [0.0, 0.0, 1.0]])
    colors, _, _ = rasterization(*gaussians, torch.eye(4)[None], K[None], width, height)
    return colors[0]


def _batch(image: Tensor) -> Tensor:
    """An image [H, W, 3] as [1, 3, H, W]."""
    return image.movedim(-1, 0)[None]


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)

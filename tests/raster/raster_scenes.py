"""Random scenes and comparisons for the rasteriser's tests."""

from __future__ import annotations

from typing import Any

import torch

from bigs.raster import RasterSettings, rasterization

DIFFERENTIABLE = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")

# No cliffs: every pair counts and no pixel stops, so the image is smooth in every input.
SMOOTH = RasterSettings(alpha_threshold=0.0, min_transmittance=0.0)


def scene(
    n: int = 12,
    channels: int = 3,
    cameras: int = 1,
    batch: tuple[int, ...] = (),
    width: int = 23,
    height: int = 18,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
    spread: float = 0.35,
) -> dict[str, Any]:
    """Gaussians before slightly different cameras; everything has the batch axes `batch`."""
    g = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*batch, *shape, generator=g, dtype=torch.float64)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*batch, *shape, generator=g, dtype=torch.float64)

    viewmats = torch.eye(4, dtype=torch.float64).repeat(*batch, cameras, 1, 1)
    viewmats[..., :3, :3] = torch.linalg.matrix_exp(_skew(0.15 * normal(cameras, 3)))
    viewmats[..., :3, 3] = 0.05 * normal(cameras, 3)
    Ks = torch.eye(3, dtype=torch.float64).repeat(*batch, cameras, 1, 1)
    Ks[..., 0, 0] = uniform(1.0, 1.3, cameras) * width
    Ks[..., 1, 1] = uniform(1.0, 1.3, cameras) * width
    Ks[..., 0, 2] = uniform(0.45, 0.55, cameras) * width
    Ks[..., 1, 2] = uniform(0.45, 0.55, cameras) * height
    depth = uniform(0.8, 1.6, n, 1)
    tensors = {
        "means": torch.cat([spread * normal(n, 2) * depth, depth], dim=-1),
        "quats": normal(n, 4),
        "scales": uniform(0.02, 0.12, n, 3),
        "opacities": uniform(0.15, 0.9, n),
        "colors": uniform(0.0, 1.0, n, channels),
        "viewmats": viewmats,
        "Ks": Ks,
        "backgrounds": uniform(0.0, 1.0, cameras, channels),
    }
    return {**{k: v.to(dtype) for k, v in tensors.items()}, "width": width, "height": height}


def without_perspective(inputs: dict[str, Any]) -> dict[str, Any]:
    """The scene for orthographic cameras: focal lengths that show at depth 1.2 what they showed before."""
    Ks = inputs["Ks"].clone()
    Ks[..., [0, 1], [0, 1]] /= 1.2
    return {**inputs, "Ks": Ks, "camera_model": "ortho"}


def _skew(v: torch.Tensor) -> torch.Tensor:
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*v.shape, 3)


def gradients(
    inputs: dict[str, Any], seed: int = 0, **options: Any
) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
    """Colors, alphas and the gradients of all given inputs under random cotangents."""
    leaves = {
        k: inputs[k].detach().clone().requires_grad_() for k in DIFFERENTIABLE if inputs.get(k) is not None
    }
    colors, alphas, _ = rasterization(**{**inputs, **leaves}, **options)
    g = torch.Generator().manual_seed(seed)
    v_colors = torch.randn(colors.shape, generator=g, dtype=torch.float64).to(colors.dtype)
    v_alphas = torch.randn(alphas.shape, generator=g, dtype=torch.float64).to(alphas.dtype)
    v = torch.autograd.grad(
        [colors, alphas],
        list(leaves.values()),
        [v_colors, v_alphas],
        allow_unused=True,
        materialize_grads=True,
    )
    return colors.detach(), alphas.detach(), dict(zip(leaves, v, strict=True))


def relative(got: torch.Tensor, expected: torch.Tensor) -> float:
    """Relative L2 difference; absolute where there is nothing to be relative to."""
    scale = expected.double().norm().item()
    difference = (got.double() - expected.double()).norm().item()
    return difference / scale if scale > 1e-9 else difference

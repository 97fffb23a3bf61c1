"""CUDA tensors through gsplat, where it is installed."""

from __future__ import annotations

import importlib
from dataclasses import fields
from types import ModuleType
from typing import Any

import torch

from bigs.checks import InputError
from bigs.raster.settings import RasterSettings

# A pixel of a tile is a thread there, and more of them than this leave each too few registers. No result
# depends on tiles.
_LARGEST_TILE = 16

# Constants of gsplat's kernels.
_FIXED = ("alpha_threshold", "max_alpha", "min_transmittance", "exp_degree")


def _gsplat() -> ModuleType:
    try:
        return importlib.import_module("gsplat")
    except ImportError:
        raise InputError(
            "backend: expected the package gsplat for CUDA tensors, found it is not installed "
            "(pip install gsplat, or move the tensors to the CPU)"
        ) from None


def rasterize(
    tensors: dict[str, torch.Tensor],
    pixel_mask: torch.Tensor | None,
    width: int,
    height: int,
    settings: RasterSettings,
    render_mode: str,
    camera_model: str,
    sh_degree: int | None,
    *,
    packed: bool,
    absgrad: bool,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Render checked inputs with equal batch axes, by the names of `bigs.raster.rasterization`.

    Raises:
        InputError: gsplat is missing, or a setting differs that gsplat cannot change.
    """
    gsplat = _gsplat()
    defaults = {field.name: field.default for field in fields(RasterSettings)}
    for name in _FIXED:
        if getattr(settings, name) != defaults[name]:
            raise InputError(
                f"settings.{name}: expected gsplat's constant {defaults[name]} for backend 'gsplat', "
                f"found {getattr(settings, name)}"
            )
    backgrounds = tensors.get("backgrounds") if "RGB" in render_mode else None
    colors, alphas, info = gsplat.rasterization(
        **{name: tensor for name, tensor in tensors.items() if name != "backgrounds"},
        width=width,
        height=height,
        backgrounds=None if packed else backgrounds,
        near_plane=settings.near_plane,
        far_plane=settings.far_plane,
        radius_clip=settings.radius_clip,
        eps2d=settings.eps2d,
        tile_size=min(settings.tile_size, _LARGEST_TILE),
        rasterize_mode="antialiased" if settings.antialiased else "classic",
        render_mode=render_mode,
        camera_model=camera_model,
        sh_degree=sh_degree,
        packed=packed,
        absgrad=absgrad,
    )
    behind = torch.zeros_like(colors[..., :1, :1, :])
    if backgrounds is not None:
        depth = colors.shape[-1] - backgrounds.shape[-1]
        behind = torch.nn.functional.pad(backgrounds, (0, depth))[..., None, None, :]
        if packed:  # gsplat 1.5 packs without backgrounds only
            colors = colors + (1.0 - alphas) * behind
    if pixel_mask is not None:
        inside = pixel_mask[..., None]
        colors = torch.where(inside, colors, behind.detach())
        alphas = torch.where(inside, alphas, torch.zeros_like(alphas))
    return colors, alphas, info

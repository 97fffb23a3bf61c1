"""The Rust engine as a differentiable torch function."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

import bigs._raster as _raster
from bigs.raster.settings import RasterSettings

# The differentiable inputs, in the order of the engine's arrays; there Ks follows viewmats.
Inputs = tuple[
    torch.Tensor,  # means [S, 1, N, 3]
    torch.Tensor,  # quats [S, 1, N, 4]
    torch.Tensor,  # scales [S, 1, N, 3]
    torch.Tensor,  # opacities [S, 1, N]
    torch.Tensor,  # colors [S, C or 1, N, D]
    torch.Tensor,  # viewmats [S, C, 4, 4]
    torch.Tensor | None,  # backgrounds [S, C, D]
]


def _array(tensor: torch.Tensor) -> np.ndarray:
    """A numpy view of a tensor; copies only what is not contiguous."""
    return tensor.detach().contiguous().numpy()


def _engine_arrays(inputs: Sequence[torch.Tensor | None], constants: Sequence[torch.Tensor | None]) -> Any:
    *gaussians_and_views, backgrounds = inputs
    Ks, pixel_mask = constants
    tensors = (*gaussians_and_views, Ks, backgrounds, pixel_mask)
    return tuple(None if tensor is None else _array(tensor) for tensor in tensors)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        constants: tuple[torch.Tensor, torch.Tensor | None],
        call: tuple[int, int, RasterSettings, str, str],
        info: dict[str, Any],
        *inputs: torch.Tensor | None,
    ) -> tuple[torch.Tensor, ...]:
        *outputs, state = _raster.rasterize_forward(_engine_arrays(inputs, constants), *call)
        info.update(state.counters())
        colors, alphas, means2d, depths, radii = map(torch.from_numpy, outputs)
        ctx.save_for_backward(*inputs, *constants)
        ctx.call, ctx.state, ctx.info, ctx.image_shape = call, state, info, colors.shape
        ctx.mark_non_differentiable(means2d, depths, radii)
        ctx.set_materialize_grads(False)
        return colors, alphas, means2d, depths, radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: torch.Tensor | None, v_alphas: torch.Tensor | None, *_: Any) -> tuple:
        *inputs, Ks, pixel_mask = ctx.saved_tensors
        if v_colors is None:
            v_colors = inputs[0].new_zeros(ctx.image_shape)
        if v_alphas is None:
            v_alphas = v_colors.new_zeros(*ctx.image_shape[:-1], 1)
        wanted = list(ctx.needs_input_grad[3:])
        width, height, settings, render_mode, camera_model = ctx.call
        *gradients, tiles_skipped = _raster.rasterize_backward(
            ctx.state,
            _engine_arrays(inputs, (Ks, pixel_mask)),
            width,
            height,
            settings,
            render_mode,
            camera_model,
            _array(v_colors),
            _array(v_alphas),
            wanted,
        )
        ctx.info["n_tiles_without_gradient"] = tiles_skipped
        return None, None, None, *map(_gradient_of, inputs, wanted, map(torch.from_numpy, gradients))


def _gradient_of(tensor: torch.Tensor | None, wanted: bool, gradient: torch.Tensor) -> torch.Tensor | None:
    if tensor is None or not wanted:
        return None
    if gradient.numel() == tensor.numel():
        return gradient.reshape(tensor.shape)
    # Of a world-to-camera matrix the engine returns three rows; the last is constant.
    rows = gradient.reshape(*tensor.shape[:-2], 3, 4)
    return torch.cat([rows, torch.zeros_like(rows[..., :1, :])], dim=-2)


def rasterize(
    inputs: Inputs,
    Ks: torch.Tensor,
    pixel_mask: torch.Tensor | None,
    width: int,
    height: int,
    settings: RasterSettings,
    render_mode: str,
    camera_model: str,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Render checked inputs whose leading axes are [entries or 1, cameras or 1].

    Returns:
        Colors [V, H, W, D], alphas [V, H, W, 1] and info, V being entries × cameras.

    Raises:
        ValueError: a value that is not finite, a camera that is none, a setting out of range.
    """
    info: dict[str, Any] = {"tile_size": settings.tile_size}
    call = (width, height, settings, render_mode, camera_model)
    outputs = _Rasterize.apply((Ks, pixel_mask), call, info, *inputs)
    colors, alphas, info["means2d"], info["depths"], info["radii"] = outputs
    return colors, alphas, info

"""The Rust engine as a differentiable torch function."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import torch
from torch.autograd.function import once_differentiable

import bigs._raster as _raster
from bigs.raster import screen
from bigs.raster.settings import RasterSettings

# In the engine's order: means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, pixel_mask.
# The first six and backgrounds are differentiable; the last two may be absent.
Inputs = tuple[torch.Tensor | None, ...]
DIFFERENTIABLE = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")

# Whether info's means2d are plain values, or a tensor in the graph: of all Gaussians, or of the visible ones.
Means2d = Literal["values", "full", "packed"]


class Extras(NamedTuple):
    """Results besides the image."""

    means2d: Means2d
    absgrad: bool
    median_depth: bool


class Call(NamedTuple):
    """Arguments of the engine besides the arrays."""

    counts: tuple[tuple[int, int], ...]
    """Of each input, how many batch entries and cameras (or 1: shared) its leading axes stand for."""
    lead: tuple[int, ...]
    """Leading axes of the images: the batch, then the cameras."""
    width: int
    height: int
    settings: RasterSettings
    render_mode: str
    camera_model: str


def _array(tensor: torch.Tensor) -> np.ndarray:
    """A numpy view of a tensor; copies only what is not contiguous or is a view of another's negative."""
    return tensor.detach().resolve_neg().contiguous().numpy()


class _Rasterize(torch.autograd.Function):
    """Images that the engine has rendered, as a function of what it rendered them from."""

    @staticmethod
    def forward(
        ctx: Any,
        images: tuple[torch.Tensor, torch.Tensor],
        state: _raster.RasterState,
        arrays: Any,
        call: Call,
        info: dict[str, Any],
        absgrad: bool,
        means2d: torch.Tensor | None,
        *inputs: torch.Tensor | None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        # Saved so that torch notices inputs changed in place; the backward pass reads the arrays.
        ctx.save_for_backward(means2d, *inputs)
        # The backward pass needs the Gaussians again; the state holds the rest.
        ctx.arrays, ctx.counts, ctx.state = arrays[:5], call.counts[:5], state
        ctx.info, ctx.absgrad = info, absgrad
        ctx.set_materialize_grads(False)
        return images

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: torch.Tensor | None, v_alphas: torch.Tensor | None) -> tuple:
        means2d, *inputs = ctx.saved_tensors
        want_means2d, *six, _Ks, backgrounds, _mask = ctx.needs_input_grad[6:]
        *gradients, v_backgrounds, v_means2d, absolute, tiles_skipped = _raster.rasterize_backward(
            ctx.state,
            ctx.arrays,
            ctx.counts,
            None if v_colors is None else _array(v_colors),
            None if v_alphas is None else _array(v_alphas),
            (*six, backgrounds, want_means2d, ctx.absgrad and want_means2d),
        )
        ctx.info["n_tiles_without_gradient"] = tiles_skipped
        ctx.info["gradients_skipped"] = tuple(
            name
            for name, tensor, want in zip(
                DIFFERENTIABLE, (*inputs[:6], inputs[7]), (*six, backgrounds), strict=True
            )
            if tensor is not None and not want
        )
        if ctx.absgrad and want_means2d:
            full, shown = torch.from_numpy(absolute).view(means2d.shape), ctx.info["means2d"]
            # An attribute in the caller's layout, as gsplat does it.
            shown.absgrad = full if shown.shape == full.shape else full[ctx.info["depths"] > 0]
        return (
            *[None] * 6,
            _gradient_of(means2d, want_means2d, v_means2d),
            *map(_gradient_of, inputs, six, gradients),
            None,
            _gradient_of(inputs[7], backgrounds, v_backgrounds),
            None,
        )


def _gradient_of(tensor: torch.Tensor | None, wanted: bool, gradient: np.ndarray) -> torch.Tensor | None:
    if tensor is None or not wanted:
        return None
    if gradient.size == tensor.numel():
        # numpy reshapes faster than torch.
        return torch.from_numpy(gradient.reshape(tensor.shape))
    # The engine returns three rows of a world-to-camera matrix; the last is constant.
    rows = torch.from_numpy(gradient.reshape(*tensor.shape[:-2], 3, 4))
    return torch.cat([rows, torch.zeros_like(rows[..., :1, :])], dim=-2)


def rasterize(
    inputs: Inputs, call: Call, extras: Extras
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Render inputs whose shapes fit.

    Returns:
        Colors [..., C, H, W, D], alphas [..., C, H, W, 1] and info.

    Raises:
        ValueError: a value that is not finite, a camera that is none, a setting out of range.
    """
    arrays: Any = tuple(None if tensor is None else _array(tensor) for tensor in inputs)
    *outputs, state = _raster.rasterize_forward(arrays, *call)
    colors, alphas, centres, depths, radii = map(torch.from_numpy, outputs)
    info: dict[str, Any] = {
        "tile_size": call.settings.tile_size,
        "tile_width": -(-call.width // call.settings.tile_size),
        "tile_height": -(-call.height // call.settings.tile_size),
        "width": call.width,
        "height": call.height,
        "n_cameras": call.lead[-1],
        "n_batches": math.prod(call.lead[:-1]),
        "means2d": centres,
        "depths": depths,
        "radii": radii,
        **state.counters(),
    }
    # Only backgrounds and the mask may be absent.
    means, viewmats, Ks = (cast(torch.Tensor, inputs[i]) for i in (0, 5, 6))
    between = None
    if extras.means2d != "values":
        seen = depths > 0
        packed = screen.centres(centres, seen, means, viewmats, Ks, call.camera_model)
        between = screen.everywhere(packed, seen)
        info["means2d"] = packed if extras.means2d == "packed" else between
    if extras.median_depth:
        ids = torch.from_numpy(state.median_ids(call.lead, call.width, call.height))
        info["median_ids"] = ids
        info["render_median"] = screen.depth_of(ids, means, viewmats)
    images = _Rasterize.apply((colors, alphas), state, arrays, call, info, extras.absgrad, between, *inputs)
    return *images, info

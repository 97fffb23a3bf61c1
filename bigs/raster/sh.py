"""Colours that depend on the direction of view: real spherical harmonics to degree 3."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch.autograd.function import once_differentiable

import bigs._raster as _raster
from bigs.checks import InputError, check_choice
from bigs.raster import reference

DEGREES = (0, 1, 2, 3)

# (degree, dirs, coeffs) to colours, like `spherical_harmonics`.
Evaluate = Callable[[int, torch.Tensor, torch.Tensor], torch.Tensor]


def spherical_harmonics(
    degree: int,
    dirs: torch.Tensor,  # [..., 3]
    coeffs: torch.Tensor,  # [..., K, 3]
    masks: torch.Tensor | None = None,  # [...]
) -> torch.Tensor:
    """Red, green and blue of spherical harmonics seen along directions, differentiable in both.

    Signs and order of the basis are those of 3D Gaussian splatting and gsplat. There the colour of a Gaussian
    is this plus 0.5, limited to at least 0; `rasterization` with `sh_degree` does that.

    Args:
        degree: 0 to 3; bases beyond (degree + 1)² are left out.
        dirs: from the camera to the Gaussian, of any length above 0.
        coeffs: K ≥ (degree + 1)² rows; leading axes may be 1 or missing where those of `dirs` are not.
        masks: bool; where it is False the colour is 0 and has no gradient.

    Returns:
        Colours [..., 3].

    Raises:
        InputError: a degree, shape or dtype that does not fit.
    """
    check_choice("degree", degree, DEGREES)
    check_coefficients("coeffs", degree, coeffs)
    if dirs.ndim < 1 or dirs.shape[-1] != 3:
        raise InputError(f"dirs: expected shape [..., 3], found {list(dirs.shape)}")
    if dirs.dtype != coeffs.dtype or dirs.dtype not in (torch.float32, torch.float64):
        raise InputError(f"dirs: expected float32 or float64 as coeffs ({coeffs.dtype}), found {dirs.dtype}")
    lead = dirs.shape[:-1]
    if masks is not None and (masks.dtype != torch.bool or masks.shape != lead):
        raise InputError(
            f"masks: expected bool of shape {list(lead)}, found {masks.dtype} of {list(masks.shape)}"
        )
    try:
        fits = torch.broadcast_shapes(coeffs.shape[:-2], lead) == lead
    except RuntimeError:
        fits = False
    if not fits:
        raise InputError(
            f"coeffs: expected leading axes that broadcast to those of dirs, {list(lead)}, "
            f"found {list(coeffs.shape[:-2])}"
        )
    if dirs.is_cuda:
        colors = reference.harmonics(degree, dirs, coeffs)
        return colors if masks is None else torch.where(masks[..., None], colors, 0.0)
    return _Harmonics.apply(degree, masks, dirs, _repeating(coeffs, lead))


def view_colors(
    evaluate: Evaluate,
    degree: int,
    means: torch.Tensor,  # [..., N, 3]
    coeffs: torch.Tensor,  # [..., N, K, 3] or [..., C, N, K, 3]
    viewmats: torch.Tensor,  # [..., C, 4, 4]
    per_camera: bool,
) -> torch.Tensor:
    """Each Gaussian's colour for each camera, [..., C, N, 3]: harmonics plus 0.5, limited to at least 0."""
    eyes = -torch.linalg.solve(viewmats[..., :3, :3], viewmats[..., :3, 3:])[..., 0]  # [..., C, 3]
    dirs = means[..., None, :, :] - eyes[..., :, None, :]
    if not per_camera:
        coeffs = coeffs[..., None, :, :, :]
    dirs = dirs.expand(*torch.broadcast_shapes(dirs.shape[:-1], coeffs.shape[:-2]), 3)
    return (evaluate(degree, dirs, coeffs) + 0.5).clamp_min(0.0)


def check_coefficients(name: str, degree: int, coeffs: torch.Tensor) -> None:
    """Raise `InputError` unless the coefficients [..., K, 3] have all bands of the degree."""
    if coeffs.ndim < 2 or coeffs.shape[-1] != 3 or coeffs.shape[-2] < (degree + 1) ** 2:
        raise InputError(
            f"{name}: expected shape [..., at least {(degree + 1) ** 2}, 3] for degree {degree}, "
            f"found {list(coeffs.shape)}"
        )


def _repeating(coeffs: torch.Tensor, lead: torch.Size) -> torch.Tensor:
    """The coefficients as [N, K, 3] that, repeated, fit the flattened directions; copied only if needed."""
    own = coeffs.shape[:-2]
    while own and own[0] == 1:
        own = own[1:]
    if own != lead[len(lead) - len(own) :]:
        own = lead
        coeffs = coeffs.expand(*own, *coeffs.shape[-2:])
    return coeffs.reshape(math.prod(own), *coeffs.shape[-2:])


class _Harmonics(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, degree: int, masks: torch.Tensor | None, dirs: torch.Tensor, coeffs: torch.Tensor
    ) -> torch.Tensor:
        ctx.save_for_backward(dirs, coeffs, masks)
        ctx.degree = degree
        colors = _raster.harmonics_forward(degree, _engine_arrays(dirs, coeffs, masks))
        return torch.from_numpy(colors).reshape(dirs.shape)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: torch.Tensor) -> tuple:
        dirs, coeffs, masks = ctx.saved_tensors
        wanted = list(ctx.needs_input_grad[2:])
        arrays = _engine_arrays(dirs, coeffs, masks)
        gradients = _raster.harmonics_backward(
            ctx.degree, arrays, v_colors.detach().contiguous().numpy(), wanted
        )
        v_dirs, v_coeffs = (
            torch.from_numpy(gradient).reshape(tensor.shape) if want else None
            for gradient, tensor, want in zip(gradients, (dirs, coeffs), wanted, strict=True)
        )
        return None, None, v_dirs, v_coeffs


def _engine_arrays(dirs: torch.Tensor, coeffs: torch.Tensor, masks: torch.Tensor | None) -> Any:
    return tuple(
        None if tensor is None else tensor.detach().contiguous().numpy() for tensor in (dirs, coeffs, masks)
    )

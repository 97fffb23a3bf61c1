"""The renderer's one call: checks its arguments and picks a backend."""

from __future__ import annotations

from typing import Literal, cast

import numpy as np
import torch

from bigs.checks import InputError, check_choice, check_finite
from bigs.raster import cuda, reference, rust, sh
from bigs.raster.arguments import Batch, batch_of, broadcast_of, check_cameras, check_kind, shapes_of
from bigs.raster.settings import RasterSettings
from bigs.types import RenderOutput

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
CameraModel = Literal["pinhole", "ortho"]
Means2d = rust.Means2d
Backend = Literal["auto", "rust", "torch", "gsplat"]


def rasterization(
    means: torch.Tensor,  # [..., N, 3]
    quats: torch.Tensor,  # [..., N, 4]
    scales: torch.Tensor,  # [..., N, 3]
    opacities: torch.Tensor,  # [..., N]
    colors: torch.Tensor,  # [..., (C,) N, D], or [..., (C,) N, K, 3] with sh_degree
    viewmats: torch.Tensor,  # [..., C, 4, 4]
    Ks: torch.Tensor,  # [..., C, 3, 3]
    width: int,
    height: int,
    *,
    settings: RasterSettings | None = None,
    backgrounds: torch.Tensor | None = None,  # [..., C, D]
    pixel_mask: torch.Tensor | None = None,  # [..., C, H, W]
    sh_degree: int | None = None,
    render_mode: RenderMode = "RGB",
    camera_model: CameraModel = "pinhole",
    means2d: Means2d = "values",
    absgrad: bool = False,
    median_depth: bool = False,
    backend: Backend = "auto",
) -> RenderOutput:
    """Render 3D Gaussians (paper Eq. 1 and 2) into C cameras, differentiably.

    Names, shapes and rules are gsplat's. Leading batch axes "..." broadcast: an input without them, or of
    size 1 along all of them, is shared by all batch entries without being copied, and its gradient is the sum
    over them. Gradients flow to means, quats, scales, opacities, colors, viewmats and backgrounds; Ks gets
    none. The result is the same, bit for bit, for any number of threads (`RAYON_NUM_THREADS`). Call it in the
    main process only: a forked worker has no threads.

    Args:
        means: centres in the world, metres.
        quats: rotations w x y z, of any length; the zero quaternion is no rotation.
        scales: standard deviations along the rotated axes, metres.
        opacities: in [0, 1]; above 1 a Gaussian is opaque further out (alpha is limited, as in gsplat), below
            0 it is not there.
        colors: any D ≥ 1 channels; with a camera axis they must have all batch axes too. With `sh_degree` the
            coefficients of spherical harmonics, and D is 3.
        viewmats: world to camera, OpenCV axes; the 3×3 part must be invertible.
        Ks: camera matrices in pixels without skew; pixel (i, j) has its centre at (i + 0.5, j + 0.5).
        width: of the images, pixels.
        height: of the images, pixels.
        settings: every threshold; gsplat's values by default.
        backgrounds: the colour behind everything; black by default. Depth has none.
        pixel_mask: bool; a pixel where it is False is neither rendered nor differentiated and shows the
            background with alpha 0.
        sh_degree: 0 to 3, None for plain colours. The direction is from the camera to the Gaussian; signs and
            order of the basis, the added 0.5 and the limit at 0 are those of 3D Gaussian splatting.
        render_mode: the colours (RGB), accumulated camera z (D), that divided by alpha (ED), or both kinds.
        camera_model: "pinhole", or "ortho": parallel rays, x = fx X + cx with fx in pixels per metre. Depth
            is camera z in both, and so are the near and the far plane.
        means2d: what `info["means2d"]` is: mere "values", or a part of the graph with a `.grad` (per pixel)
            after `retain_grad()`, as densification needs: "full", or "packed" [nnz, 2] without those that no
            pixel sees. Backend "torch" has values only.
        absgrad: the backward pass leaves `info["means2d"].absgrad`, sums over pixels of absolute gradients
            (AbsGS), of up to eight channels at a time. Needs means2d other than "values".
        median_depth: adds `info["render_median"]` [..., C, H, W, 1]: camera z of the last Gaussian that more
            than half of a pixel's light reaches, 0 for none, differentiable in means and viewmats, as in 2D
            Gaussian splatting. And `info["median_ids"]` [..., C, H, W], -1 for none. Not for "gsplat".
        backend: "rust" (CPU), "torch" (slow and obvious), "gsplat" (CUDA), or "auto": rust for CPU tensors,
            gsplat for CUDA tensors.

    Returns:
        Colors [..., C, H, W, D], with depth as the last channel where asked for, alphas [..., C, H, W, 1] and
        info: means2d [..., C, N, 2] and radii [..., C, N, 2] in pixels, depths [..., C, N] (zeros for a
        Gaussian that no pixel sees), tile_size. The rust backend adds gsplat's tile_width, tile_height,
        width, height, n_cameras, n_batches, and counts of its work, summed over the images: n_isects pairs of
        Gaussian and tile, n_visible and n_culled Gaussians that some or no pixel can see, n_empty_tiles that
        no Gaussian reaches or that pixel_mask closes, n_saturated pixels that stopped at min_transmittance.
        A backward pass adds n_tiles_without_gradient, reached by Gaussians but not by a gradient, and
        gradients_skipped, the names of the inputs that asked for none. What is culled, empty, behind a
        saturated pixel or without gradient is skipped.

    Raises:
        InputError: a shape, dtype, value or camera that cannot be rendered.
    """
    settings = RasterSettings() if settings is None else settings
    if not isinstance(settings, RasterSettings):
        raise InputError(f"settings: expected RasterSettings, found {type(settings).__name__}")
    check_choice("render_mode", render_mode, ("RGB", "D", "ED", "RGB+D", "RGB+ED"))
    check_choice("camera_model", camera_model, ("pinhole", "ortho"))
    check_choice("means2d", means2d, ("values", "full", "packed"))
    check_choice("backend", backend, ("auto", "rust", "torch", "gsplat"))
    if absgrad and means2d == "values":
        raise InputError("absgrad: expected means2d 'full' or 'packed' with it, found 'values'")
    tensors = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
        "viewmats": viewmats,
        "Ks": Ks,
    }
    if backgrounds is not None:
        tensors["backgrounds"] = backgrounds
    check_kind(tensors, pixel_mask)
    if sh_degree is not None:
        check_choice("sh_degree", sh_degree, sh.DEGREES)
        sh.check_coefficients("colors", sh_degree, colors)
    batch = batch_of(shapes_of(tensors, pixel_mask), width, height, sh_degree)
    if backend == "auto":
        backend = "gsplat" if means.is_cuda else "rust"
    if backend == "rust":
        if means.is_cuda:
            raise InputError("means: expected CPU tensors for backend 'rust', found a CUDA tensor")
        if sh_degree is not None:
            check_cameras(viewmats, Ks)
        try:
            return _render_rust(
                *_with_view_colors(tensors, batch, sh.spherical_harmonics),
                pixel_mask,
                settings,
                render_mode,
                camera_model,
                rust.Extras(means2d, absgrad, median_depth),
            )
        except ValueError as error:
            # The engine's message counts in its flat arrays; report the caller's shapes.
            check_cameras(viewmats, Ks)
            for name, tensor in tensors.items():
                check_finite(name, tensor)
            raise InputError(str(error)) from None
    check_cameras(viewmats, Ks)
    for name, tensor in tensors.items():
        check_finite(name, tensor)
    expanded = _expanded(tensors, batch)
    mask = None if pixel_mask is None else pixel_mask.expand(*batch.shape, *pixel_mask.shape[-3:])
    if backend == "gsplat":
        if median_depth:
            raise InputError("median_depth: expected False for backend 'gsplat', which has none")
        return RenderOutput(
            *cuda.rasterize(
                expanded,
                mask,
                batch.width,
                batch.height,
                settings,
                render_mode,
                camera_model,
                sh_degree,
                packed=means2d == "packed",
                absgrad=absgrad,
            )
        )
    if means2d != "values":
        raise InputError(f"means2d: expected 'values' for backend 'torch', found '{means2d}'")
    return _render_torch(
        *_with_view_colors(expanded, batch, reference.harmonics),
        mask,
        settings,
        render_mode,
        camera_model,
        median_depth,
    )


def _with_view_colors(
    tensors: dict[str, torch.Tensor], batch: Batch, evaluate: sh.Evaluate
) -> tuple[dict[str, torch.Tensor], Batch]:
    """The inputs with plain colours: what each camera sees, where the colours are harmonics."""
    if batch.sh_degree is None:
        return tensors, batch
    colors = sh.view_colors(
        evaluate,
        batch.sh_degree,
        tensors["means"],
        tensors["colors"],
        tensors["viewmats"],
        batch.colors_per_camera,
    )
    return {**tensors, "colors": colors}, batch._replace(colors_per_camera=True, sh_degree=None)


def _render_rust(
    tensors: dict[str, torch.Tensor],
    batch: Batch,
    pixel_mask: torch.Tensor | None,
    settings: RasterSettings,
    render_mode: RenderMode,
    camera_model: CameraModel,
    extras: rust.Extras,
) -> RenderOutput:
    broadcast = broadcast_of(shapes_of(tensors, pixel_mask), batch)
    inputs = (*tensors.values(), *([] if "backgrounds" in tensors else [None]), pixel_mask)
    if any(broadcast.shapes):
        inputs = tuple(
            tensor if shape is None else cast(torch.Tensor, tensor).expand(shape)
            for tensor, shape in zip(inputs, broadcast.shapes, strict=True)
        )
    call = rust.Call(
        broadcast.counts,
        (*batch.shape, batch.cameras),
        batch.width,
        batch.height,
        settings,
        render_mode,
        camera_model,
    )
    return RenderOutput(*rust.rasterize(inputs, call, extras))


def _expanded(tensors: dict[str, torch.Tensor], batch: Batch) -> dict[str, torch.Tensor]:
    """All inputs with all batch axes."""
    axes = {
        "opacities": 1,
        "viewmats": 3,
        "Ks": 3,
        "colors": 2 + batch.colors_per_camera + (batch.sh_degree is not None),
    }
    return {
        name: x.expand(*batch.shape, *x.shape[x.ndim - axes.get(name, 2) :]) for name, x in tensors.items()
    }


def _render_torch(
    tensors: dict[str, torch.Tensor],
    batch: Batch,
    pixel_mask: torch.Tensor | None,
    settings: RasterSettings,
    render_mode: RenderMode,
    camera_model: CameraModel,
    median_depth: bool,
) -> RenderOutput:
    results = []
    for index in np.ndindex(*batch.shape, batch.cameras):
        entry = index[:-1]
        background = tensors["backgrounds"][index] if "backgrounds" in tensors else None
        results.append(
            reference.rasterize_view(
                tensors["means"][entry],
                tensors["quats"][entry],
                tensors["scales"][entry],
                tensors["opacities"][entry],
                tensors["colors"][index if batch.colors_per_camera else entry],
                tensors["viewmats"][index],
                tensors["Ks"][index],
                width=batch.width,
                height=batch.height,
                settings=settings,
                background=background,
                pixel_mask=None if pixel_mask is None else pixel_mask[index],
                render_mode=render_mode,
                camera_model=camera_model,
            )
        )
    lead = (*batch.shape, batch.cameras)
    images, alphas, infos = zip(*results, strict=True)
    if not median_depth:
        infos = tuple({k: v for k, v in i.items() if "median" not in k} for i in infos)
    info = {
        name: torch.stack([i[name] for i in infos]).reshape(*lead, *infos[0][name].shape) for name in infos[0]
    }
    return RenderOutput(
        torch.stack(images).reshape(*lead, *images[0].shape),
        torch.stack(alphas).reshape(*lead, *alphas[0].shape),
        {"tile_size": settings.tile_size, **info, "means2d": info["means2d"].detach()},
    )

"""gsplat's own call, so that a script written for it runs on a CPU when its import is changed.

    from bigs.raster.gsplat import rasterization  # was: from gsplat import rasterization

What cannot be done here is refused by name; nothing that would change the result is ignored.
"""

from __future__ import annotations

from typing import Any, Literal

import torch

from bigs.checks import InputError, check_choice
from bigs.raster.api import RenderMode
from bigs.raster.api import rasterization as _rasterization
from bigs.raster.settings import RasterSettings
from bigs.raster.sh import spherical_harmonics

__all__ = ["rasterization", "spherical_harmonics"]

# Why these arguments are refused.
_WHY = {
    "sparse_grad": "gradients are dense",
    "distributed": "one process renders everything",
    "covars": "shapes are given as quats and scales",
    "with_ut": "Gaussians are projected by a linear map, not by an unscented transform",
    "with_eval3d": "Gaussians are evaluated in the image, not in space",
    "radial_coeffs": "images must be undistorted",
    "tangential_coeffs": "images must be undistorted",
    "thin_prism_coeffs": "images must be undistorted",
    "ftheta_coeffs": "cameras are pinhole or ortho",
    "rolling_shutter": "all rows of an image are taken at once",
    "viewmats_rs": "all rows of an image are taken at once",
}


def rasterization(
    means: torch.Tensor,  # [..., N, 3]
    quats: torch.Tensor,  # [..., N, 4]
    scales: torch.Tensor,  # [..., N, 3]
    opacities: torch.Tensor,  # [..., N]
    colors: torch.Tensor,  # [..., (C,) N, D] or [..., (C,) N, K, 3]
    viewmats: torch.Tensor,  # [..., C, 4, 4]
    Ks: torch.Tensor,  # [..., C, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: torch.Tensor | None = None,  # [..., C, D]
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: Literal["pinhole", "ortho", "fisheye", "ftheta"] = "pinhole",
    segmented: bool = False,
    covars: torch.Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: torch.Tensor | None = None,
    tangential_coeffs: torch.Tensor | None = None,
    thin_prism_coeffs: torch.Tensor | None = None,
    ftheta_coeffs: Any | None = None,
    rolling_shutter: Any | None = None,
    viewmats_rs: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Render Gaussians by gsplat 1.5's arguments, in its order; `bigs.raster.rasterization` explains most.

    Args:
        packed: layout of the meta only: entries of what is seen, [nnz, ...], in the order of batch, camera,
            Gaussian, numbered by batch_ids, camera_ids, gaussian_ids; otherwise [..., C, N, ...].
        absgrad: the backward pass leaves `meta["means2d"].absgrad`: sums over pixels of absolute gradients.
        channel_chunk: how gsplat cuts many channels; no part of the result and not used.
        segmented: how gsplat sorts; no part of the result and not used.
        sparse_grad, distributed, covars, with_ut, with_eval3d, radial_coeffs, tangential_coeffs,
            thin_prism_coeffs, ftheta_coeffs, rolling_shutter, viewmats_rs: refused unless left at their
            defaults (rolling_shutter: None or gsplat's GLOBAL), as are fisheye and ftheta cameras.

    Returns:
        Colors [..., C, H, W, D], alphas [..., C, H, W, 1] and the meta: batch_ids, camera_ids, gaussian_ids
        (None unless packed), radii, means2d, depths, opacities (as given, also when "antialiased"), width,
        height, tile_size, tile_width, tile_height, n_batches, n_cameras. There are no conics and no lists of
        intersections. `meta["means2d"].retain_grad()` works as gsplat's densification expects.

    Raises:
        InputError: an argument that is not supported, or one that cannot be rendered.
    """
    check_choice("camera_model", camera_model, ("pinhole", "ortho"))
    _refuse(
        sparse_grad=sparse_grad,
        distributed=distributed,
        covars=covars,
        with_ut=with_ut,
        with_eval3d=with_eval3d,
        radial_coeffs=radial_coeffs,
        tangential_coeffs=tangential_coeffs,
        thin_prism_coeffs=thin_prism_coeffs,
        ftheta_coeffs=ftheta_coeffs,
        rolling_shutter=None if getattr(rolling_shutter, "name", None) == "GLOBAL" else rolling_shutter,
        viewmats_rs=viewmats_rs,
    )
    check_choice("rasterize_mode", rasterize_mode, ("classic", "antialiased"))
    settings = RasterSettings(
        tile_size=tile_size,
        eps2d=eps2d,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        antialiased=rasterize_mode == "antialiased",
    )
    images, alphas, info = _rasterization(
        means,
        quats,
        scales,
        opacities,
        colors,
        viewmats,
        Ks,
        width,
        height,
        settings=settings,
        backgrounds=backgrounds,
        sh_degree=sh_degree,
        render_mode=render_mode,
        camera_model=camera_model,  # type: ignore[arg-type]
        means2d="packed" if packed else "full",
        absgrad=absgrad,
    )
    return images, alphas, info if means.is_cuda else _meta(info, opacities, packed)


def _refuse(**arguments: Any) -> None:
    for name, value in arguments.items():
        if value is not None and value is not False:
            raise InputError(f"{name}: expected gsplat's default because {_WHY[name]}, found another value")


def _meta(info: dict[str, Any], opacities: torch.Tensor, packed: bool) -> dict[str, Any]:
    """The info of the engine with the rest of gsplat's names, and in its packed layout."""
    depths = info["depths"]  # [..., C, N]
    shown = opacities[..., None, :].expand(depths.shape)
    meta = {**info, "opacities": shown, "batch_ids": None, "camera_ids": None, "gaussian_ids": None}
    if not packed:
        return meta
    cameras, gaussians = depths.shape[-2:]
    seen = depths > 0
    which = torch.nonzero(seen.reshape(-1, cameras, gaussians))
    meta["batch_ids"], meta["camera_ids"], meta["gaussian_ids"] = which.unbind(-1)
    for name in ("radii", "depths", "opacities"):
        meta[name] = meta[name][seen]
    return meta

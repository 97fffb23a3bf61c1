"""Other renderers that run on a CPU, used where they are installed. None of them is a dependency."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any
from unittest import mock

import torch

from bigs.bench.pairs import composited_in_tile
from bigs.raster import RasterSettings

# leaves by name, viewmat [4, 4], K [3, 3], width, height -> image [H, W, 3] and extra information
Render = Callable[[dict[str, torch.Tensor], torch.Tensor, torch.Tensor, int, int], tuple[torch.Tensor, dict]]

_TILE = 16


@dataclass(frozen=True)
class Peer:
    """Another package, and how it is called."""

    package: str
    install: str
    note: str  # note for readers of its numbers
    bytes_per_pair: int  # memory per composited pair, so that hopeless runs are not started
    render: Render


def is_installed(name: str) -> bool:
    """Whether a peer can be imported."""
    return importlib.util.find_spec(PEERS[name].package) is not None


def version(name: str) -> str:
    """The installed version of a peer, as its package says; empty if it does not."""
    try:
        return importlib.metadata.version(PEERS[name].package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _gsplat_torch(
    leaves: dict[str, torch.Tensor], viewmat: torch.Tensor, K: torch.Tensor, width: int, height: int
) -> tuple[torch.Tensor, dict[str, Any]]:
    """gsplat's own torch reference, stage by stage, as its tests chain them.

    Two things it calls exist only as CUDA kernels: the search for the pairs that a pixel composites, and
    nerfacc's scans over them. Plain torch stands in for both; all else, gradients too, is gsplat's.
    """
    torch_impl = importlib.import_module("gsplat.cuda._torch_impl")
    wrapper = importlib.import_module("gsplat.cuda._wrapper")
    covars, _ = torch_impl._quat_scale_to_covar_preci(leaves["quats"], leaves["scales"], compute_preci=False)
    radii, means2d, depths, conics, _ = torch_impl._fully_fused_projection(
        leaves["means"], covars, viewmat[None], K[None], width, height
    )
    columns, rows = math.ceil(width / _TILE), math.ceil(height / _TILE)
    _, keys, ids = torch_impl._isect_tiles(means2d.detach(), radii, depths.detach(), _TILE, columns, rows)
    offsets = torch_impl._isect_offset_encode(keys, 1, columns, rows)
    nerfacc = SimpleNamespace(
        render_weight_from_alpha=_weights_of_alphas, accumulate_along_rays=_accumulate_along_rays
    )
    with (
        mock.patch.dict("sys.modules", {"nerfacc": nerfacc}),
        mock.patch.object(wrapper, "rasterize_to_indices_in_range", _indices_in_range),
    ):
        colors, _ = torch_impl._rasterize_to_pixels(
            means2d,
            conics,
            leaves["colors"][None],
            leaves["opacities"][None],
            width,
            height,
            _TILE,
            offsets.reshape(1, rows, columns),
            ids,
        )
    return colors[0], {"n_isects": len(ids)}


@torch.no_grad()
def _indices_in_range(
    start: int,
    end: int,
    transmittances: torch.Tensor,  # [1, H, W]
    means2d: torch.Tensor,  # [1, N, 2]
    conics: torch.Tensor,  # [1, N, 3]
    opacities: torch.Tensor,  # [1, N]
    width: int,
    height: int,
    tile_size: int,
    offsets: torch.Tensor,  # [1, rows, columns]
    ids: torch.Tensor,  # [M] tile by tile, front to back
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Gaussian, pixel and image of each composited pair in a range of blocks of the lists, by pixel."""
    block = tile_size * tile_size
    starts = offsets.flatten().tolist()
    ends = [*starts[1:], len(ids)]
    columns = offsets.shape[-1]
    settings = RasterSettings()
    gaussians, pixels = [], []
    for tile, (first, last) in enumerate(zip(starts, ends, strict=True)):
        chosen = ids[first + start * block : min(last, first + end * block)].long()
        if len(chosen) == 0:
            continue
        y0, x0 = tile // columns * tile_size, tile % columns * tile_size
        ys, xs = torch.arange(y0, min(y0 + tile_size, height)), torch.arange(x0, min(x0 + tile_size, width))
        indices = (ys[:, None] * width + xs).flatten()
        centres = torch.stack([indices % width, indices // width], dim=-1).to(means2d) + 0.5
        open_for = transmittances.flatten()[indices]
        live = composited_in_tile(
            means2d[0, chosen], conics[0, chosen], opacities[0, chosen], centres, open_for, settings
        )
        pixel, gaussian = torch.nonzero(live, as_tuple=True)
        gaussians.append(chosen[gaussian])
        pixels.append(indices[pixel])
    if not gaussians:
        return tuple(torch.zeros(3, 0, dtype=torch.long))
    found = torch.cat(gaussians), torch.cat(pixels)
    return *found, torch.zeros_like(found[0])


def _weights_of_alphas(
    alphas: torch.Tensor, *, ray_indices: torch.Tensor, n_rays: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights alpha · T of samples [M] that lie ray by ray, and T, the product of 1 - alpha before them."""
    logarithms = torch.log1p(-alphas.double())
    before = torch.cumsum(logarithms, dim=0) - logarithms
    first = torch.ones_like(ray_indices, dtype=torch.bool)
    first[1:] = ray_indices[1:] != ray_indices[:-1]
    at_start = before[first][torch.cumsum(first, dim=0) - 1]
    transmittances = torch.exp(before - at_start).to(alphas.dtype)
    return alphas * transmittances, transmittances


def _accumulate_along_rays(
    weights: torch.Tensor, values: torch.Tensor | None, *, ray_indices: torch.Tensor, n_rays: int
) -> torch.Tensor:
    """Sums of weights times values per ray; [n_rays, D]."""
    weighted = weights[:, None] if values is None else weights[:, None] * values
    return weighted.new_zeros(n_rays, weighted.shape[-1]).index_add(0, ray_indices, weighted)


PEERS: dict[str, Peer] = {
    "gsplat": Peer(
        "gsplat",
        "pip install --no-deps gsplat jaxtyping",
        "its torch reference, gsplat.cuda._torch_impl; plain torch stands in for two steps that it has "
        "only as CUDA kernels",
        280,
        _gsplat_torch,
    ),
}

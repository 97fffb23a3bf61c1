"""Composited pairs: the (pixel, Gaussian) pairs that make an image, the work that no renderer can avoid."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch

from bigs.bench.workloads import Workload
from bigs.raster import RasterSettings


def composited_in_tile(
    means2d: torch.Tensor,  # [L, 2] pixels, front to back
    conics: torch.Tensor,  # [L, 3]: xx, xy, yy of the inverse covariance
    opacities: torch.Tensor,  # [L]
    pixels: torch.Tensor,  # [P, 2] centres
    transmittances: torch.Tensor,  # [P] before the first Gaussian
    settings: RasterSettings,
) -> torch.Tensor:
    """Which Gaussians a tile's pixels composite [P, L]: alpha reaches the threshold, the pixel is open."""
    offsets = pixels[:, None] - means2d
    x, y = offsets.unbind(-1)
    a, b, c = conics.unbind(-1)
    alphas = opacities * torch.exp(-0.5 * (a * x * x + c * y * y) - b * x * y)
    hit = alphas >= settings.alpha_threshold
    left = torch.where(hit, 1 - alphas.clamp(max=settings.max_alpha), torch.ones_like(alphas))
    after = transmittances[:, None] * torch.cumprod(left, dim=-1)
    return hit & (after > settings.min_transmittance)


def count_pairs(workload: Workload, settings: RasterSettings) -> int:
    """How many pairs an image of the workload is made of, counted in float64 without the engine."""
    means2d, conics, opacities, boxes = _project(workload, settings)
    total = 0
    for chosen, pixels in _tiles(workload, boxes):
        tile = composited_in_tile(
            means2d[chosen],
            conics[chosen],
            opacities[chosen],
            pixels,
            torch.ones(len(pixels)).double(),
            settings,
        )
        total += int(tile.sum())
    return total


def _project(
    workload: Workload, settings: RasterSettings
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, np.ndarray]:
    """Gaussians on screen front to back: centres, conics, opacities, boxes [M, 4] x0 y0 x1 y1 in pixels."""
    means, quats, scales, opacities = (
        torch.from_numpy(workload.gaussians[name]).double()
        for name in ("means", "quats", "scales", "opacities")
    )
    view, K = torch.from_numpy(workload.viewmat).double(), torch.from_numpy(workload.K).double()
    points = means @ view[:3, :3].T + view[:3, 3]
    keep = (points[:, 2] > settings.near_plane) & (opacities >= settings.alpha_threshold)
    order = torch.nonzero(keep)[:, 0]
    order = order[torch.argsort(points[order, 2], stable=True)]
    (x, y, z), opacities = points[order].unbind(-1), opacities[order]
    w, i, j, k = torch.nn.functional.normalize(quats[order], dim=-1).unbind(-1)
    # The rows of the rotation matrix, one after the other.
    rotations = torch.stack(
        [
            1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j),
            2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i),
            2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j),
        ],
        dim=-1,
    ).reshape(-1, 3, 3)  # fmt: skip
    focal, centre = torch.diagonal(K)[:2], K[:2, 2]
    size = torch.tensor([workload.width, workload.height]).double()
    slopes = torch.stack([x, y], dim=-1) / z[:, None]
    limited = slopes.clamp(-(centre + 0.15 * size) / focal, (size - centre + 0.15 * size) / focal)
    jacobian = torch.zeros(len(order), 2, 3).double()
    jacobian[:, (0, 1), (0, 1)] = focal / z[:, None]
    jacobian[:, :, 2] = -focal * limited / z[:, None]
    axes = jacobian @ view[:3, :3] @ (rotations * scales[order, None])
    covs = axes @ axes.transpose(-1, -2) + settings.eps2d * torch.eye(2).double()
    inverse = torch.linalg.inv(covs)
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], dim=-1)
    means2d = slopes * focal + centre
    reach = 2 * torch.log(opacities / max(settings.alpha_threshold, 1e-12))
    radii = (reach[:, None] * torch.diagonal(covs, dim1=-2, dim2=-1)).clamp(min=0).sqrt()
    return means2d, conics, opacities, torch.cat([means2d - radii, means2d + radii], dim=-1).numpy()


def _tiles(
    workload: Workload, boxes: np.ndarray, side: int = 32
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """For each tile the Gaussians whose box meets it, in order, and its pixel centres [P, 2]."""
    columns = math.ceil(workload.width / side)
    for row in range(math.ceil(workload.height / side)):
        y0, y1 = row * side, min((row + 1) * side, workload.height)
        in_row = np.nonzero((boxes[:, 1] < y1) & (boxes[:, 3] > y0))[0]
        for column in range(columns):
            x0, x1 = column * side, min((column + 1) * side, workload.width)
            chosen = in_row[(boxes[in_row, 0] < x1) & (boxes[in_row, 2] > x0)]
            if len(chosen):
                xs, ys = torch.arange(x0, x1) + 0.5, torch.arange(y0, y1) + 0.5
                pixels = torch.cartesian_prod(xs, ys).reshape(-1, 2).double()
                yield torch.from_numpy(chosen), pixels

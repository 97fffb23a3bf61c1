"""`cut_templates` and `lay` as chains of torch operations on whole arrays: the slow twin of the engine."""

from __future__ import annotations

import numpy as np
import torch

from bigs.motion.patches import Laid, PatchConfig, Pictures, Templates


def sample(crop: torch.Tensor, places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Grey values and shares of object [B, S] at places [B, S, 2] of a crop [2, h, w]."""
    size = places.new_tensor([crop.shape[2], crop.shape[1]])
    grey, on = torch.nn.functional.grid_sample(
        crop[None], (2.0 * places / size - 1.0)[None], align_corners=False, padding_mode="border"
    )[0]
    return grey, on * ((places > 0) & (places < size)).all(-1)


def offsets(config: PatchConfig) -> torch.Tensor:
    """Places of a patch about its middle [S, 2]."""
    line = torch.arange(-config.half, config.half + 1, dtype=torch.float64)
    row, column = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([column.ravel(), row.ravel()], dim=1)


def crop_of(pictures: Pictures, t: int) -> torch.Tensor:
    return torch.from_numpy(pictures[t]).double()


def cut_twin(pictures: Pictures, t: int, pixels: np.ndarray, config: PatchConfig) -> Templates:
    """The patches of one frame at `pixels` [N, 2]."""
    crop, spread = crop_of(pictures, t), offsets(config)
    places = torch.from_numpy(pictures.places(t, pixels)).double()[:, None] + spread
    grey, on = sample(crop, places)
    bell = torch.exp(-0.5 * (spread**2).sum(1) / (0.6 * config.half) ** 2)
    steps = 0.5 * torch.eye(2, dtype=torch.float64)
    slopes = [sample(crop, places + step)[0] - sample(crop, places - step)[0] for step in steps]
    found = (grey, torch.stack(slopes, dim=-1), bell * (on > 0.99))
    return Templates(*(part.float().numpy() for part in found))


def lay_twin(
    pictures: Pictures,
    t: int,
    start: np.ndarray,
    warp: np.ndarray,
    templates: Templates,
    config: PatchConfig,
) -> tuple[Laid, np.ndarray]:
    """Where patches come to lie, and the likeness [N] of each there."""
    crop = crop_of(pictures, t)
    template, slopes, counts = (torch.from_numpy(part).double() for part in templates)
    turn = torch.from_numpy(warp)
    places = began = torch.from_numpy(pictures.places(t, start)).double()
    spread = torch.einsum("nij,sj->nsi", turn, offsets(config))
    on = sample(crop, places[:, None] + spread)[1] > 0.5
    weight = counts * on
    shown = weight.sum(1) / counts.sum(1).clamp_min(1e-9)
    weight = (weight + 1e-9) / (weight + 1e-9).sum(1, keepdim=True)
    wanted, deviation = standardised(template, weight)
    slope = slopes / deviation[..., None]
    slope = slope - (weight[..., None] * slope).sum(1, keepdim=True)
    normal = torch.einsum("ns,nsi,nsj->nij", weight, slope, slope)
    size = normal.diagonal(dim1=1, dim2=2).sum(1)
    ridge = (1e-3 * size + 1e-9)[:, None, None] * torch.eye(2)
    for _ in range(config.iterations):
        seen, _ = standardised(sample(crop, places[:, None] + spread)[0], weight)
        pull = torch.einsum("ns,nsi,ns->ni", weight, slope, seen - wanted)
        step = torch.linalg.solve(normal + ridge, pull[..., None])[..., 0].clamp(-1.5, 1.5)
        places = places - torch.einsum("nij,nj->ni", turn, step)
    seen, _ = standardised(sample(crop, places[:, None] + spread)[0], weight)
    likeness = (weight * seen * wanted).sum(1)
    noise = (2.0 * (1.0 - likeness)).clamp_min(1e-6) * (weight**2).sum(1)
    sigma = (noise / torch.linalg.eigvalsh(normal)[:, 0].clamp_min(1e-9)).sqrt()
    fits = (
        (likeness > config.likeness)
        & ((places - began).norm(dim=1) < config.most_moved)
        & (shown > config.least_shown)
        & (pictures.shrunk * sigma < config.most_unsure)
    )
    covariance = pictures.shrunk**2 * noise[:, None, None] * turn @ torch.linalg.pinv(normal) @ turn.mT
    return Laid(pictures.pixels(t, places.numpy()), covariance.numpy(), fits.numpy()), likeness.numpy()


def standardised(grey: torch.Tensor, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Values [N, S] less their weighted mean over their deviation, and that deviation [N, 1]."""
    centred = grey - (weight * grey).sum(1, keepdim=True)
    deviation = (weight * centred**2).sum(1, keepdim=True).sqrt().clamp_min(1e-3)
    return centred / deviation, deviation

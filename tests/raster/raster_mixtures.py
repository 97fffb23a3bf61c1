"""Random scenes in which many kinds of hostility meet."""

from __future__ import annotations

from typing import Any

import torch
from raster_hostile import rounded

from bigs.raster import RasterSettings

SIZES = ((1, 1), (2, 31), (45, 38), (17, 64), (200, 3), (33, 33), (16, 16))


class Dice:
    """Random choices and numbers of a seed."""

    def __init__(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)

    def one_of(self, *options: Any) -> Any:
        return options[int(torch.randint(len(options), (), generator=self._generator))]

    def uniform(self, *shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=self._generator, dtype=torch.float64)

    def normal(self, *shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=self._generator, dtype=torch.float64)

    def some(self, count: int, share: float) -> torch.Tensor:
        """Which of so many are picked."""
        return self.uniform(count) < share


def mixture(seed: int) -> tuple[dict[str, Any], RasterSettings]:
    """A scene and its rules; exact in float32, as float64."""
    dice = Dice(seed)
    n = dice.one_of(1, 2, 7, 40, 40, 150)
    width, height = dice.one_of(*SIZES)
    Ks = _camera_matrix(dice, width, height)
    focal, centre = Ks[0, [0, 1], [0, 1]], Ks[0, [0, 1], 2]

    depths = 1 + dice.uniform(n) * dice.one_of(0.5, 3.0, 30.0)
    size = torch.tensor([width, height], dtype=torch.float64)
    pixels = (1.6 * dice.uniform(n, 2) - 0.3) * size
    means = torch.cat([(pixels - centre) / focal * depths[:, None], depths[:, None]], -1)
    # From a tenth of a pixel to 30.
    scales = (depths / focal[0] * 10 ** (2.5 * dice.uniform(n) - 1))[:, None] * (0.3 + dice.uniform(n, 3))
    for change in (_needles, _discs, _points, _odd_units, _coincident):
        change(dice, means, scales)
    turned = torch.linalg.qr(dice.normal(3, 3))[0] if dice.one_of(False, True) else torch.eye(3).double()
    if dice.one_of(False, False, True):
        turned = turned @ torch.diag(10 ** (2 * dice.uniform(3) - 1))
    shift = dice.normal(3) * dice.one_of(0.1, 10.0)
    unit = 10 ** (12 * float(dice.uniform(1)) - 6) if dice.one_of(False, False, True) else 1.0
    means[dice.some(n, 0.03)] *= -1  # behind the camera
    means[dice.some(n, 0.03)] *= 0.0101  # next to the near plane, and huge from there
    viewmats = torch.eye(4, dtype=torch.float64)[None]
    viewmats[0, :3, :3], viewmats[0, :3, 3] = turned, shift * unit
    channels = dice.one_of(1, 3, 4, 9)
    inputs = {
        "means": torch.linalg.solve(turned, (means - shift).T).T * unit,
        "quats": _quats(dice, n),
        "scales": scales * unit,
        "opacities": _opacities(dice, n),
        "colors": dice.uniform(n, channels) * dice.one_of(1.0, 100.0) - dice.one_of(0.0, 0.5),
        "viewmats": viewmats,
        "Ks": Ks,
        "width": width,
        "height": height,
    }
    if dice.one_of(False, True):
        inputs["backgrounds"] = dice.uniform(1, channels)
    settings = RasterSettings(
        tile_size=dice.one_of(32, 16, 8, 4),
        eps2d=dice.one_of(0.3, 0.05, 0.0),
        near_plane=0.01 * unit,
        max_alpha=dice.one_of(0.999, 0.7),
        antialiased=dice.one_of(False, True),
        alpha_threshold=1e-7,
        min_transmittance=0.0,
    )
    return rounded(inputs), settings


def _camera_matrix(dice: Dice, width: int, height: int) -> torch.Tensor:
    focal = 10 ** (5 * float(dice.uniform(1))) if dice.one_of(False, True) else 1.3 * max(width, height)
    Ks = torch.eye(3, dtype=torch.float64)[None]
    Ks[0, 0, 0], Ks[0, 1, 1] = focal, focal * dice.one_of(1.0, 0.3, 4.0)
    Ks[0, 0, 2], Ks[0, 1, 2] = width * dice.one_of(0.5, -2.0), height * dice.one_of(0.5, 4.0)
    return Ks


def _needles(dice: Dice, means: torch.Tensor, scales: torch.Tensor) -> None:
    scales[dice.some(len(scales), 0.08), dice.one_of(0, 1, 2)] *= 1e4


def _discs(dice: Dice, means: torch.Tensor, scales: torch.Tensor) -> None:
    flat = dice.some(len(scales), 0.08)
    scales[flat] = scales[flat].amax(-1, keepdim=True) * torch.tensor([1.0, 1.0, 1e-6], dtype=scales.dtype)


def _points(dice: Dice, means: torch.Tensor, scales: torch.Tensor) -> None:
    scales[dice.some(len(scales), 0.08), dice.one_of(0, 1, 2)] = 0.0
    scales[dice.some(len(scales), 0.08)] *= -1


def _odd_units(dice: Dice, means: torch.Tensor, scales: torch.Tensor) -> None:
    odd = dice.some(len(scales), 0.08)
    scales[odd] *= 10 ** (10 * dice.uniform(int(odd.sum()), 3) - 5)


def _coincident(dice: Dice, means: torch.Tensor, scales: torch.Tensor) -> None:
    again = torch.nonzero(dice.some(len(means), 0.08))[:, 0]
    means[again] = means[again - 1]


def _quats(dice: Dice, n: int) -> torch.Tensor:
    quats = dice.normal(n, 4)
    odd = dice.some(n, 0.2)
    quats[odd] *= 10 ** (30 * dice.uniform(int(odd.sum()), 1) - 15)
    quats[dice.some(n, 0.03)] = 0.0
    return quats


def _opacities(dice: Dice, n: int) -> torch.Tensor:
    opacities = dice.uniform(n) * dice.one_of(0.02, 0.3, 1.0)
    opacities[dice.some(n, 0.04)] *= -1
    opacities[dice.some(n, 0.04)] = 3.0
    opacities[dice.some(n, 0.02)] = 0.0
    return opacities

"""Form factors against their twin in torch and against integrals known in closed form."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from bigs.fused.occlusion import Discs, form_factors


def random_surface(seed: int, count: int, dtype=torch.float64) -> Discs:
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(2, count, 3, generator=generator, dtype=torch.float64)
    normals = torch.nn.functional.normalize(
        torch.randn(2, count, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    areas = 0.1 * torch.rand(count, generator=generator, dtype=torch.float64)
    return Discs(points.to(dtype), normals.to(dtype), areas.to(dtype))


def twin(points: Tensor, normals: Tensor, discs: Discs) -> Tensor:
    away = discs.points[:, None] - points[:, :, None]
    squared = away.square().sum(-1)
    ways = torch.nn.functional.normalize(away, dim=-1)
    above = (ways * normals[:, :, None]).sum(-1).clamp_min(0.0)
    towards = -(ways * discs.normals[:, None]).sum(-1).clamp_max(0.0)
    return (discs.areas * above * towards / (math.pi * squared + discs.areas)).sum(-1)


@pytest.mark.parametrize("count", [1, 16, 53])
def test_sums_are_the_twin_s(count: int) -> None:
    at, discs = random_surface(1, 11), random_surface(2, count)
    torch.testing.assert_close(form_factors(at.points, at.normals, discs), twin(at.points, at.normals, discs))


def test_single_precision_is_near_double() -> None:
    single, double = (
        form_factors(*random_surface(1, 300, dtype)[:2], random_surface(2, 300, dtype))
        for dtype in (torch.float32, torch.float64)
    )
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), double, atol=1e-5, rtol=1e-5)


def test_a_surface_covers_nothing_of_itself_where_it_is_convex() -> None:
    count = 2000
    z = 1.0 - (2.0 * torch.arange(count).double() + 1.0) / count
    turn = torch.pi * (3.0 - 5.0**0.5) * torch.arange(count).double()
    flat = (1.0 - z * z).sqrt()
    normals = torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=-1)[None]
    ball = Discs(0.05 * normals, normals, torch.full((count,), 4 * math.pi * 0.05**2 / count).double())
    assert not form_factors(ball.points, ball.normals, ball).any()
    # From outside it covers (r / d)^2 of the sky of what faces it.
    above = torch.tensor([[[0.0, 0.0, 0.2]]], dtype=torch.float64)
    down = torch.tensor([[[0.0, 0.0, -1.0]]], dtype=torch.float64)
    torch.testing.assert_close(form_factors(above, down, ball).item(), (0.05 / 0.2) ** 2, atol=0, rtol=0.02)
    assert not form_factors(above, -down, ball).any()


def test_what_does_not_fit_is_refused() -> None:
    at, discs = random_surface(1, 11), random_surface(2, 7)
    for wrong in (
        (at.points[:1], at.normals[:1], discs),
        (at.points, at.normals[:, :5], discs),
        (at.points, at.normals, discs._replace(areas=discs.areas[:5])),
        (at.points[..., :2], at.normals, discs),
    ):
        with pytest.raises(ValueError, match="expected"):
            form_factors(*wrong)
    with pytest.raises(TypeError, match="float64"):
        form_factors(at.points, at.normals, random_surface(2, 7, torch.float32))

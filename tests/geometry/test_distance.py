"""The sampled distance field against functions it must reproduce."""

import numpy as np
import torch

from bigs.geometry.distance import DistanceField
from bigs.geometry.surface import DistanceGrid, empty_grid

LOWER, UPPER = np.array([-0.06, -0.08, -0.05]), np.array([0.06, 0.07, 0.09])
RADIUS = 0.04


def sampled(function, resolution: int) -> DistanceField:
    grid = empty_grid(LOWER, UPPER, resolution)
    values = function(grid.points()).reshape(grid.values.shape)
    return DistanceField(DistanceGrid(values, grid.origin, grid.spacing)).double()


def sphere(points):
    return np.linalg.norm(points, axis=-1) - RADIUS


def random_points(count: int, spread: float, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return spread * (2.0 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1.0)


def test_a_linear_function_is_exact_so_no_axes_are_swapped() -> None:
    slope = np.array([1.0, 2.0, -3.0])
    field = sampled(lambda points: points @ slope + 0.3, 10)
    points = random_points(200, 0.049)
    torch.testing.assert_close(field(points), points @ torch.as_tensor(slope) + 0.3, atol=3e-6, rtol=0)


def test_sphere_inside_the_grid() -> None:
    field = sampled(sphere, 48)
    points = random_points(500, 0.049)
    points = points[points.norm(dim=-1) > 0.01]  # the centre is a kink
    spacing = 0.15 / 48
    error = (field(points) - (points.norm(dim=-1) - RADIUS)).abs().max()
    assert error < 0.5 * spacing**2 / 0.01
    assert field(torch.zeros(1, 3).double()) < -RADIUS + spacing


def test_beyond_the_grid_the_way_to_the_box_is_added() -> None:
    field = sampled(sphere, 48)
    outside = torch.tensor([[0.30, 0.0, 0.0], [0.0, -0.50, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(field(outside), outside.norm(dim=-1) - RADIUS, atol=1e-4, rtol=0)
    assert (field(random_points(100, 2.0) + 3.0) > 0.5).all()


def test_any_leading_axes() -> None:
    field = sampled(sphere, 16)
    points = random_points(12, 0.1)
    assert torch.equal(field(points.reshape(3, 4, 3)), field(points).reshape(3, 4))

"""Bilinear samples against values computed by hand."""

import pytest
import torch

from bigs.fields.triplane import Triplane, TriplaneConfig, sample_triplane

R = 5
BOUNDS = torch.tensor([[-1.0, 0.0, 2.0], [3.0, 8.0, 3.0]], dtype=torch.float64)


@pytest.fixture
def planes() -> torch.Tensor:
    return torch.randn(3, 2, R, R, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def position(x: float, y: float, z: float) -> torch.Tensor:
    """The point [1, 3] at texel coordinates 0 .. R - 1 along each axis of the box."""
    lower, upper = BOUNDS
    return (lower + (upper - lower) * torch.tensor([x, y, z], dtype=torch.float64) / (R - 1))[None]


def texel(planes: torch.Tensor, x: int, y: int, z: int) -> torch.Tensor:
    """Features [6] of the texels: the first axis of each pair runs along columns, the second along rows."""
    return torch.cat([planes[0, :, y, x], planes[1, :, z, x], planes[2, :, z, y]])


@pytest.mark.parametrize("at", [(0, 0, 0), (4, 4, 4), (1, 3, 2), (4, 0, 1)])
def test_a_texels_centre_gives_its_features(planes, at) -> None:
    torch.testing.assert_close(sample_triplane(planes, position(*at), BOUNDS)[0], texel(planes, *at))


def test_between_texels_the_mean_is_bilinear(planes) -> None:
    # x is a quarter of the way from 1 to 2, y half way from 2 to 3, z on texel 4.
    expected = torch.zeros(6, dtype=torch.float64)
    for x, wx in ((1, 0.75), (2, 0.25)):
        for y, wy in ((2, 0.5), (3, 0.5)):
            expected += wx * wy * texel(planes, x, y, 4)
    torch.testing.assert_close(sample_triplane(planes, position(1.25, 2.5, 4), BOUNDS)[0], expected)


def test_outside_the_box_the_borders_features_are_taken(planes) -> None:
    sampled = sample_triplane(planes, position(-3.0, 2.0, 9.0), BOUNDS)[0]
    torch.testing.assert_close(sampled, texel(planes, 0, 2, 4))


def test_points_are_sampled_independently(planes) -> None:
    points = torch.cat([position(0.3, 1.7, 2.2), position(3.9, 0.1, 0.6), position(2.0, 2.0, 2.0)])
    together = sample_triplane(planes, points, BOUNDS)
    assert together.shape == (3, 6)
    for i in range(3):
        torch.testing.assert_close(together[i : i + 1], sample_triplane(planes, points[i : i + 1], BOUNDS))


def test_gradients(planes) -> None:
    points = torch.cat([position(0.3, 1.7, 2.2), position(3.4, 0.1, 0.6)]).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda planes, points: sample_triplane(planes, points, BOUNDS), (planes.requires_grad_(), points)
    )


def test_module_holds_planes_of_the_configured_size_and_spread() -> None:
    torch.manual_seed(0)
    triplane = Triplane(TriplaneConfig(features=4, resolution=32, init_std=0.25), BOUNDS.float())
    assert triplane.planes.shape == (3, 4, 32, 32) and triplane.out_features == 12
    assert triplane.planes.std().item() == pytest.approx(0.25, rel=0.05)
    points = position(1.2, 0.4, 3.3).float()
    assert torch.equal(triplane(points), sample_triplane(triplane.planes, points, BOUNDS.float()))
    # The box travels with a checkpoint: the same planes over another box are another field.
    assert set(triplane.state_dict()) == {"planes", "bounds"}

"""Virtual cameras: they look at the object from where they should, and see all of it."""

from __future__ import annotations

import math

import pytest
import torch

from bigs.guidance.cameras import draw_directions, make_orbit, view_weights, virtual_cameras

POINTS = 0.1 * torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([0.3, -0.2, 0.1])
ORBIT = make_orbit(POINTS, torch.tensor([0.0, 0.0, 2.0]), torch.tensor([1.0, 0.0, 0.5]))


def directions(count: int = 50) -> torch.Tensor:
    some = torch.randn(count, 3, generator=torch.Generator().manual_seed(1))
    return torch.nn.functional.normalize(some, dim=-1)


def test_all_of_the_object_is_in_every_picture() -> None:
    poles = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    cameras = virtual_cameras(ORBIT, torch.cat([directions(), poles]), 64)
    for viewmat in cameras.viewmats:
        cam = POINTS @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = cam @ cameras.K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        assert (cam[:, 2] > 0).all() and (pixels > 0).all() and (pixels < 64).all()
        # And it fills a good part of it.
        assert float((pixels.amax(0) - pixels.amin(0)).max()) > 25.0


def test_cameras_are_rotations_with_up_up() -> None:
    cameras = virtual_cameras(ORBIT, directions(), 64)
    rotations = cameras.viewmats[:, :3, :3]
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3).expand(50, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(50))
    # The picture's y axis points down.
    assert (rotations[:, 1] @ ORBIT.up < 0).all()
    centers = -(rotations.mT @ cameras.viewmats[:, :3, 3:])[..., 0] - ORBIT.center
    torch.testing.assert_close(
        torch.nn.functional.normalize(centers, dim=-1), directions(), atol=1e-4, rtol=0
    )


@pytest.mark.parametrize(
    ("direction", "azimuth", "elevation"),
    [((1, 0, 0), 0, 0), ((0, 1, 0), 90, 0), ((-1, 0, 0), 180, 0), ((0, -1, 0), -90, 0), ((1, 0, 1), 0, 45)],
)
def test_azimuth_and_elevation(direction: tuple[float, ...], azimuth: float, elevation: float) -> None:
    unit = torch.nn.functional.normalize(torch.tensor([direction], dtype=torch.float32), dim=-1)
    cameras = virtual_cameras(ORBIT, unit, 64)
    assert math.degrees(cameras.azimuths[0]) == pytest.approx(azimuth, abs=1e-3)
    assert math.degrees(cameras.elevations[0]) == pytest.approx(elevation, abs=1e-3)


def test_a_front_straight_above_serves() -> None:
    orbit = make_orbit(POINTS, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, 1.0]))
    assert abs(float(orbit.front @ orbit.up)) < 1e-6
    assert float(orbit.front.norm()) == pytest.approx(1.0)


def test_well_seen_directions_are_never_drawn() -> None:
    weights = view_weights(torch.tensor([0.0, 0.5, 0.9]), well_seen=0.85)
    torch.testing.assert_close(weights, torch.tensor([1.0, 0.5, 0.0]))
    axes = torch.eye(3)
    drawn = draw_directions(axes, weights, 6000, torch.Generator().manual_seed(0), jitter=0.0)
    torch.testing.assert_close(drawn.mean(0), torch.tensor([2 / 3, 1 / 3, 0.0]), atol=0.02, rtol=0)

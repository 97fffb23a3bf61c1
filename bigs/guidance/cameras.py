"""Virtual cameras on a sphere around the canonical object, more of them where the clip did not look."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor


class VirtualCameras(NamedTuple):
    """B cameras that look at the object's middle, OpenCV axes."""

    viewmats: Tensor  # [B, 4, 4] object to camera
    K: Tensor  # [3, 3]
    azimuths: Tensor  # [B] radians about `up`, 0 at the front, anticlockwise seen from above
    elevations: Tensor  # [B] radians


class Orbit(NamedTuple):
    """The sphere: where it is, and which way is up and front."""

    center: Tensor  # [3] metres, the object's middle
    radius: float  # metres, radius of a ball about the object
    up: Tensor  # [3] unit
    front: Tensor  # [3] unit, orthogonal to `up`


# Field of view in degrees, and the share of the half picture that the object's ball fills.
_FIELD_OF_VIEW = 40.0
_FILL = 0.9


def make_orbit(points: Tensor, up: Tensor, front: Tensor) -> Orbit:
    """The sphere about points [N, 3]; `up` and `front` [3] need be neither unit nor at right angles."""
    lower, upper = points.amin(0), points.amax(0)
    center = 0.5 * (lower + upper)
    radius = float((points - center).norm(dim=-1).max())
    up = torch.nn.functional.normalize(up, dim=0)
    across = front - (front @ up) * up
    if float(across.norm()) < 1e-3:
        # The front is straight above or below: any orthogonal direction serves.
        across = torch.linalg.cross(up, torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())])
    return Orbit(center, radius, up, torch.nn.functional.normalize(across, dim=0))


def view_weights(coverage: Tensor, well_seen: float) -> Tensor:
    """How often each of D directions is looked from, [D]: what of it was not seen; 0 from `well_seen` on.

    Args:
        coverage: [D] in [0, 1], see `geometry.coverage.coverage_by_direction`.
        well_seen: such directions are skipped.
    """
    return torch.where(coverage < well_seen, 1.0 - coverage, torch.zeros_like(coverage))


def draw_directions(
    directions: Tensor, weights: Tensor, count: int, generator: torch.Generator, jitter: float = 0.1
) -> Tensor:
    """`count` unit directions [count, 3] near some of `directions` [D, 3], drawn by `weights` [D]."""
    chosen = torch.multinomial(weights, count, replacement=True, generator=generator)
    moved = directions[chosen] + jitter * torch.randn(count, 3, generator=generator)
    return torch.nn.functional.normalize(moved, dim=-1)


def virtual_cameras(orbit: Orbit, directions: Tensor, size: int) -> VirtualCameras:
    """Cameras that see the whole object from unit directions [B, 3], for pictures of `size` x `size`."""
    half = math.radians(0.5 * _FIELD_OF_VIEW)
    distance = orbit.radius / math.sin(half * _FILL)
    level = directions @ orbit.up
    # For a camera straight above or below, the front is up in the picture.
    above = torch.where(level.abs()[:, None] > 0.999, -level.sign()[:, None] * orbit.front, orbit.up)
    forward = -directions
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, above), dim=-1)
    rotations = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=-2)
    viewmats = torch.eye(4, dtype=directions.dtype).repeat(len(directions), 1, 1)
    viewmats[:, :3, :3] = rotations
    viewmats[:, :3, 3] = -(rotations @ orbit.center)
    viewmats[:, 2, 3] += distance
    focal = 0.5 * size / math.tan(half)
    K = torch.tensor([[focal, 0.0, 0.5 * size], [0.0, focal, 0.5 * size], [0.0, 0.0, 1.0]]).to(directions)
    left = torch.linalg.cross(orbit.up, orbit.front)
    azimuths = torch.atan2(directions @ left, directions @ orbit.front)
    return VirtualCameras(viewmats, K, azimuths, torch.asin(level.clamp(-1.0, 1.0)))

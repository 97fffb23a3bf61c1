"""The mesh goes half-way to the Gaussians about it, and only to those of its own side; and it is smooth."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from half_seen import gaussians
from torch import Tensor

from bigs.models.canonical import CanonicalObject
from bigs.models.scene import ObjectSurface
from bigs.train.unseen.learned_surface import learned_surface

RADIUS = 0.05


def ball(noise: float = 0.0) -> ObjectSurface:
    mesh = trimesh.creation.icosphere(4, radius=RADIUS)
    aside = 1.0 + noise / RADIUS * np.random.default_rng(1).standard_normal((len(mesh.vertices), 1))
    return ObjectSurface(
        torch.as_tensor(aside * mesh.vertices, dtype=torch.float32), torch.as_tensor(mesh.faces)
    )


def shell(radius: float, facing: float = 1.0, noise: float = 0.0) -> CanonicalObject:
    """Gaussians on a sphere about the ball, that face away from its middle or towards it."""
    normals = trimesh.creation.icosphere(4).vertices
    aside = noise * np.random.default_rng(0).standard_normal(len(normals))
    return gaussians((radius + aside)[:, None] * normals, facing * normals, np.full_like(normals, 0.5))


def radii(whole: CanonicalObject, start: ObjectSurface | None = None) -> Tensor:
    start = start or ball()
    moved = learned_surface(start, whole)
    assert torch.equal(moved.faces, start.faces)
    return moved.verts.norm(dim=1)


@pytest.fixture(scope="module")
def alone() -> Tensor:
    """Radii of the ball without a Gaussian in reach."""
    found = radii(shell(2.0 * RADIUS))
    torch.testing.assert_close(found, torch.full_like(found, RADIUS), atol=3e-4, rtol=0.0)
    return found


def test_the_surface_goes_half_way(alone: Tensor) -> None:
    for off in (-0.004, 0.0, 0.004):
        torch.testing.assert_close(radii(shell(RADIUS + off)), alone + 0.5 * off, atol=1e-4, rtol=0.0)


def test_many_gaussians_outvote_noise(alone: Tensor) -> None:
    """Single Gaussians that are millimetres off move it by tenths of that."""
    assert (radii(shell(RADIUS, noise=0.002)) - alone).abs().mean() < 2e-4


def test_noise_of_the_start_is_smoothed_away() -> None:
    rough = ball(noise=0.0005)
    before = rough.verts.norm(dim=1).std()
    assert radii(shell(RADIUS), rough).std() < 0.4 * before


def test_another_side_and_what_is_far_or_transparent_do_not_count(alone: Tensor) -> None:
    faint = shell(RADIUS + 0.004)
    for whole in (
        shell(RADIUS - 0.004, facing=-1.0),
        shell(RADIUS + 0.012),
        faint._replace(opacities=0.001 * faint.opacities),
    ):
        torch.testing.assert_close(radii(whole), alone, atol=1e-6, rtol=0.0)
    one = CanonicalObject(*(values[:1] for values in faint))
    assert (radii(one) - alone).abs().max() < 2.5e-3


def test_what_no_gaussian_covers_stays(alone: Tensor) -> None:
    whole = shell(RADIUS + 0.004)
    half = CanonicalObject(*(values[whole.means[:, 0] > 0] for values in whole))
    moved, across = radii(half), ball().verts[:, 0]
    torch.testing.assert_close(moved[across < -0.03], alone[across < -0.03], atol=1e-5, rtol=0.0)
    torch.testing.assert_close(moved[across > 0.02], alone[across > 0.02] + 0.002, atol=2e-4, rtol=0.0)

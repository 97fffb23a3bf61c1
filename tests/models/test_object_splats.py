"""The object's Gaussians: their start, their bounds, and a similarity transform written out."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from posing_twin import third_axis
from small_scene import OBJECT, OBJECT_RADIUS, covariances, disturb, object_splats, rotations

from bigs.geometry.mesh import point_spacing
from bigs.models.object_splats import ObjectSplats, pose_object, region_weights
from bigs.models.poses import ObjectFrames


def changed(**config):
    torch.manual_seed(0)
    made = object_splats(replace(OBJECT, **config))
    disturb(made, 0.3)
    return made


@torch.no_grad()
def test_a_fresh_object_is_its_start_less_the_inset() -> None:
    obj = object_splats()()
    spacing = torch.as_tensor(point_spacing(OBJECT_RADIUS * obj.normals.numpy()), dtype=torch.float32)
    torch.testing.assert_close(obj.scales[:, 0], OBJECT.scale_per_spacing * spacing)
    torch.testing.assert_close(obj.scales[:, 2], OBJECT.flatness * obj.scales[:, 1])
    outer = obj.means + obj.scales[:, 2:] * obj.normals
    torch.testing.assert_close(outer, OBJECT_RADIUS * obj.normals, atol=1e-7, rtol=0)
    torch.testing.assert_close(third_axis(obj.quats), obj.normals, atol=1e-6, rtol=0)
    torch.testing.assert_close(obj.colors, 0.5 + 0.4 * obj.normals, atol=1e-6, rtol=0)
    torch.testing.assert_close(obj.opacities, torch.full((60,), OBJECT.opacity))
    assert not obj.offsets.any()


def test_start_colours_of_0_and_1_can_still_change() -> None:
    normals = np.eye(3)
    made = ObjectSplats(normals, normals, np.array([[0.0, 0, 0], [1, 1, 1], [0, 1, 0]]), OBJECT)
    made().colors.sum().backward()
    assert made().colors.isfinite().all()
    assert made.appearance.color.bias.grad.isfinite().all() and made.appearance.color.bias.grad.all()


@torch.no_grad()
def test_the_field_moves_centres_within_its_bound() -> None:
    made = changed()
    obj = made()
    torch.testing.assert_close(obj.means, made.base_points + obj.offsets)
    assert 0 < obj.offsets.abs().max() <= OBJECT.max_offset
    assert not torch.allclose(obj.quats, made.base_quats)


@torch.no_grad()
def test_isotropic_gaussians_stay_balls() -> None:
    scales = changed(isotropic=True)().scales
    torch.testing.assert_close(scales, scales[:, :1].expand(-1, 3))
    assert not torch.allclose(scales, object_splats(replace(OBJECT, isotropic=True))().scales, rtol=1e-2)
    anisotropic = changed()().scales
    assert not torch.allclose(anisotropic[:, 0], anisotropic[:, 1])


@pytest.mark.parametrize("scale", [1.0, 1.7])
@torch.no_grad()
def test_posing_is_a_similarity_transform(scale: float) -> None:
    obj = changed()()
    frames = ObjectFrames(rotations(3, angle=1.5), torch.randn(3, 3), torch.tensor(scale))
    posed = pose_object(obj, frames)
    canonical = covariances(posed._replace(quats=obj.quats, scales=obj.scales))
    for t in range(3):
        matrix = torch.eye(4)
        matrix[:3, :3] = scale * frames.rotations[t]
        matrix[:3, 3] = frames.centers[t]
        expected = torch.stack([(matrix @ torch.cat([x, torch.ones(1)]))[:3] for x in obj.means])
        torch.testing.assert_close(posed.means[t], expected)
        linear = matrix[:3, :3]
        one = posed._replace(quats=posed.quats[t])
        torch.testing.assert_close(covariances(one), linear @ canonical @ linear.T, atol=1e-9, rtol=1e-4)
    assert torch.equal(posed.colors, obj.colors) and torch.equal(posed.opacities, obj.opacities)


def test_a_checkpoint_carries_the_start() -> None:
    """An object that began from other points becomes the same by the state alone."""
    one = changed()
    generator = np.random.default_rng(0)
    normals = generator.normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    other = ObjectSplats(0.1 * normals, normals, generator.uniform(size=(60, 3)), OBJECT)
    assert not any(torch.equal(a, b) for a, b in zip(one(), other(), strict=True))
    other.load_state_dict(one.state_dict(), strict=True)
    for a, b in zip(one(), other(), strict=True):
        assert torch.equal(a, b)


def test_every_part_of_the_object_learns() -> None:
    made = changed()
    posed = pose_object(made(), ObjectFrames(rotations(2), torch.randn(2, 3), torch.tensor(1.2)))
    generator = torch.Generator().manual_seed(5)
    sum((value * torch.randn(value.shape, generator=generator)).sum() for value in posed).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() and p.grad.any() for p in made.parameters())


def test_regions_are_smooth_even_and_have_a_side() -> None:
    """On a thin plate: every region is somebody's, neighbours agree, and front and back do not mix."""
    grid = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 30), np.linspace(-0.05, 0.05, 15)), -1).reshape(-1, 2)
    sides = np.repeat([0.001, -0.001], len(grid))
    points = np.c_[np.tile(grid, (2, 1)), sides]
    normals = np.c_[np.zeros((len(points), 2)), np.sign(sides)]
    weights = region_weights(points, normals, 16)
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=1e-9)
    assert weights.min() >= 0 and weights.max(0).min() > 0.5
    owned = np.bincount(weights.argmax(1), minlength=16)
    assert owned.min() > 0.2 * len(points) / 16 and owned.max() < 3 * len(points) / 16
    steps = np.abs(np.diff(weights[:30], axis=0)).sum(1)
    assert steps.max() < 0.5
    front, back = weights[: len(grid)].sum(0), weights[len(grid) :].sum(0)
    assert (np.minimum(front, back) < 0.3 * np.maximum(front, back)).all()

"""What of a hand touches an object: compiled against the same in torch."""

from __future__ import annotations

import pytest
import torch
from posing_twin import blended
from torch import Tensor

from bigs.fused.posing import Posing
from bigs.fused.touch import Group, Touch, distances, touch
from bigs.geometry.rotations import axis_angle_to_matrix

FRAMES, VERTS, BONES, RADIUS = 3, 40, 2, 0.5
BOUNDS = torch.tensor([[-1.0, -1.1, -0.9], [1.0, 1.2, 1.1]], dtype=torch.float64)


def random(*shape: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2.0 * torch.rand(*shape, generator=generator, dtype=torch.float64) - 1.0


def ball(size: tuple[int, int, int] = (12, 14, 13)) -> Tensor:
    """Distances [Z, Y, X] from a ball about the origin."""
    axes = [torch.linspace(*BOUNDS[:, i].tolist(), size[i], dtype=torch.float64) for i in (0, 1, 2)]
    z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    return (x * x + y * y + z * z).sqrt() - RADIUS


def hand(moving: bool, mirrored: bool) -> Posing:
    weights = random(VERTS, BONES, seed=2).abs()
    turns = axis_angle_to_matrix(random(FRAMES, BONES, 3, seed=3))
    upper = torch.cat([turns, 0.2 * random(FRAMES, BONES, 3, 1, seed=4)], dim=-1)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(FRAMES, BONES, 1, 4)
    points = random(FRAMES, VERTS, 3, seed=1)
    return Posing(
        (points if moving else points[0]).clone().requires_grad_(),
        weights / weights.sum(1, keepdim=True),
        torch.cat([upper, last], dim=-2).requires_grad_(),
        mirrored=mirrored,
    )


def carrier() -> tuple[Tensor, Tensor, Tensor]:
    turns = axis_angle_to_matrix(random(FRAMES, 3, seed=5))
    scale = torch.tensor(1.2, dtype=torch.float64)
    return turns.requires_grad_(), (0.3 * random(FRAMES, 3, seed=6)).requires_grad_(), scale.requires_grad_()


def sampled(points: Tensor, values: Tensor) -> Tensor:
    """Trilinear samples, and beyond the grid the way to its box."""
    inside = torch.minimum(torch.maximum(points, BOUNDS[0]), BOUNDS[1])
    size = torch.tensor(values.shape).flip(0)
    place = (inside - BOUNDS[0]) / (BOUNDS[1] - BOUNDS[0]) * (size - 1)
    first = torch.minimum(place.detach().floor().long(), size - 2)
    share = place - first
    total = torch.zeros(points.shape[:-1], dtype=torch.float64)
    for corner in torch.cartesian_prod(*[torch.tensor([0, 1])] * 3):
        x, y, z = (first + corner).unbind(-1)
        total = total + torch.where(corner == 1, share, 1.0 - share).prod(-1) * values[z, y, x]
    return total + ((points - inside).square().sum(-1) + 1e-12).sqrt()


def twin(
    posing: Posing,
    rotations: Tensor,
    centers: Tensor,
    scale: Tensor,
    values: Tensor,
    groups: list[Group],
    tolerance: float,
) -> Touch:
    points = blended(posing)
    own = (points - centers[:, None]) @ rotations / scale
    found = scale * sampled(own, values)
    sunk = torch.relu(-found - tolerance).square().sum(1)

    def depth(group: Group) -> Tensor:
        own = found if group.vertices is None else found[:, group.vertices]
        return own.topk(min(group.deepest, own.shape[1]), dim=1, largest=False).values.mean(1)

    return Touch(torch.stack([depth(group) for group in groups], dim=1), sunk)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("deepest", [1, 7, 99])
def test_what_touches_is_what_the_twin_finds(moving: bool, mirrored: bool, deepest: int) -> None:
    posing, object_frames, values = hand(moving, mirrored), carrier(), ball()
    groups = [Group(deepest), Group(3, (0, 2, 5, 11, 17)), Group(deepest, (39,))]
    found = touch(posing, *object_frames, values, BOUNDS, groups, 0.02)
    expected = twin(posing, *object_frames, values, groups, 0.02)
    assert (expected.sunk > 0).all()
    inputs = (posing.points, posing.bones, *object_frames)
    pulls = random(FRAMES, len(groups), seed=7), torch.tensor([0.7, -1.3, 0.4], dtype=torch.float64)
    for a, b, pull in zip(found, expected, pulls, strict=True):
        torch.testing.assert_close(a, b, atol=1e-12, rtol=1e-10)
        one, other = (torch.autograd.grad(v, inputs, pull, retain_graph=True) for v in (a, b))
        for x, y in zip(one, other, strict=True):
            torch.testing.assert_close(x, y, atol=1e-10, rtol=1e-8)


def test_gradients_are_finite_differences() -> None:
    posing = hand(moving=False, mirrored=True)

    def both(points: Tensor, bones: Tensor, *object_frames: Tensor) -> tuple[Tensor, Tensor]:
        moved = posing._replace(points=points, bones=bones)
        groups = [Group(7), Group(2, (1, 4, 30))]
        return touch(moved, *object_frames, ball(), BOUNDS, groups, 0.02)

    assert torch.autograd.gradcheck(both, (posing.points, posing.bones, *carrier()), eps=1e-7, atol=1e-5)


def test_single_precision_is_near_double() -> None:
    posing, object_frames = hand(moving=False, mirrored=False), carrier()
    single = Posing(*(None if t is None else t.detach().float() for t in posing[:-1]))
    others = (t.detach().float() for t in (*object_frames, ball(), BOUNDS))
    found = touch(single, *others, [Group(7)], 0.02)
    for a, b in zip(found, touch(posing, *object_frames, ball(), BOUNDS, [Group(7)], 0.02), strict=True):
        assert a.dtype == torch.float32
        torch.testing.assert_close(a.double(), b, atol=1e-5, rtol=1e-4)


def test_of_equal_distances_as_many_count_as_are_asked_for() -> None:
    # All vertices in one place beyond the ball: three of them share the gradient, whichever they are.
    posing = Posing(
        torch.full((VERTS, 3), 0.6, dtype=torch.float64).requires_grad_(),
        torch.ones(VERTS, 1, dtype=torch.float64),
        torch.eye(4, dtype=torch.float64).expand(FRAMES, 1, 4, 4),
    )
    still = torch.eye(3, dtype=torch.float64).expand(FRAMES, 3, 3)
    centers, scale = torch.zeros(FRAMES, 3, dtype=torch.float64), torch.ones((), dtype=torch.float64)
    found = touch(posing, still, centers, scale, ball(), BOUNDS, [Group(3)], 0.02)
    (pull,) = torch.autograd.grad(found.depths.sum(), posing.points)
    assert (pull != 0).any(1).sum() == 3
    assert not found.sunk.any()


def test_poses_that_are_not_finite_show() -> None:
    posing, (rotations, centers, scale) = hand(moving=False, mirrored=False), carrier()
    centers = centers.detach().clone()
    centers[1] = torch.nan
    found = touch(posing, rotations, centers, scale, ball(), BOUNDS, [Group(7)], 0.02)
    for values in found:
        assert values.view(FRAMES).isnan().tolist() == [False, True, False]


def test_distances_are_samples_of_the_grid() -> None:
    points = 2.0 * random(5, 20, 3, seed=9)
    torch.testing.assert_close(distances(points, ball(), BOUNDS), sampled(points, ball()))


def test_what_does_not_fit_is_refused() -> None:
    posing, object_frames = hand(moving=False, mirrored=False), carrier()
    for wrong in (
        posing._replace(points=posing.points[:5]),
        posing._replace(bones=posing.bones[:, :1]),
        posing._replace(points=posing.points[:0], weights=posing.weights[:0]),
    ):
        with pytest.raises(ValueError, match="expected"):
            touch(wrong, *object_frames, ball(), BOUNDS, [Group(7)], 0.02)
    for group in (Group(0), Group(1, ()), Group(1, (VERTS,)), Group(1, (3, 2))):
        with pytest.raises(ValueError, match="groups: expected rising vertices"):
            touch(posing, *object_frames, ball(), BOUNDS, [group], 0.02)
    with pytest.raises(ValueError, match="at least two along each axis"):
        touch(posing, *object_frames, ball((1, 14, 13)), BOUNDS, [Group(7)], 0.02)

"""Splitting: the same picture from finer Gaussians, with no field behind them."""

from __future__ import annotations

import pytest
import torch

from bigs.checks import InputError
from bigs.models.canonical import CanonicalObject
from bigs.models.object_detail import ObjectDetail, split_object
from bigs.raster import rasterization


def plate(side: int = 8, spacing: float = 0.01) -> CanonicalObject:
    """An opaque square plate at z = 0.5 whose colour changes from left to right."""
    steps = spacing * (torch.arange(side) - 0.5 * (side - 1))
    means = torch.cat([torch.cartesian_prod(steps, steps), torch.full((side * side, 1), 0.5)], dim=1)
    count = len(means)
    colors = torch.stack([means[:, 0] / 0.1 + 0.5, torch.full((count,), 0.4), 0.5 - means[:, 0] / 0.1], -1)
    scales = torch.tensor([0.6 * spacing, 0.6 * spacing, 0.1 * spacing]).repeat(count, 1)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    normals = torch.tensor([0.0, 0.0, -1.0]).repeat(count, 1)
    weights = torch.eye(16)[torch.arange(count) % 16]
    opacities = torch.full((count,), 0.95)
    return CanonicalObject(means, 0 * means, quats, scales, opacities, colors, normals, weights)


def picture(obj: CanonicalObject) -> torch.Tensor:
    K = torch.tensor([[300.0, 0.0, 32.0], [0.0, 300.0, 32.0], [0.0, 0.0, 1.0]])
    parts = (obj.means, obj.quats, obj.scales, obj.opacities, obj.colors)
    return rasterization(*parts, torch.eye(4)[None], K[None], 64, 64).colors[0].detach()


def test_one_part_is_the_same_object() -> None:
    whole = plate()
    same = split_object(whole, 1, 0.0)()
    for name in ("means", "quats", "scales", "opacities", "colors", "normals", "weights"):
        torch.testing.assert_close(getattr(same, name), getattr(whole, name), atol=1e-5, rtol=1e-4)
    assert not same.offsets.any()


@pytest.mark.parametrize("parts", [2, 3])
def test_parts_cover_the_same_surface(parts: int) -> None:
    whole = plate()
    fine = split_object(whole, parts, 0.0)()
    assert len(fine.means) == parts**2 * len(whole.means)
    torch.testing.assert_close(fine.means.mean(0), whole.means.mean(0))
    inner = (slice(16, 48), slice(16, 48))
    difference = (picture(fine)[inner] - picture(whole)[inner]).abs()
    assert difference.mean() < 0.02, "the picture hardly changes"
    # Neighbouring parts are evenly spread: the finer plate is a grid of its own.
    xs = fine.means[:, 0].unique()
    gaps = xs[torch.cat([torch.tensor([True]), xs.diff() > 1e-5])].diff()
    torch.testing.assert_close(gaps, torch.full_like(gaps, 0.01 / parts), atol=1e-5, rtol=0)


def test_each_has_as_many_parts_as_it_is_told() -> None:
    whole = plate()
    parts = torch.arange(len(whole.means)) % 3 + 1
    opacities = torch.where(torch.arange(len(parts)) < 5, 0.01, whole.opacities)
    detail = split_object(whole._replace(opacities=opacities), parts, 0.05)
    fine, own = detail(), torch.arange(len(parts))[5:].repeat_interleave(parts[5:].square())
    assert len(fine.means) == len(own)
    for number in (1, 2, 3):
        alike = split_object(whole._replace(opacities=opacities), number, 0.05)()
        rows = torch.arange(len(parts))[5:].repeat_interleave(number**2)
        for name in ("means", "quats", "scales", "opacities", "colors", "normals", "weights"):
            torch.testing.assert_close(
                getattr(fine, name)[parts[own] == number], getattr(alike, name)[parts[rows] == number]
            )


def test_parts_overlap_and_what_stays_whole_does_not() -> None:
    whole = plate()
    parts = torch.arange(len(whole.means)) % 2 + 1
    plain, wide = (split_object(whole, parts, 0.0, overlap=overlap)() for overlap in (1.0, 1.5))
    split = (parts == 2).repeat_interleave(parts.square())
    factor = torch.tensor([1.5, 1.5, 1.0])
    torch.testing.assert_close(wide.scales[split], plain.scales[split] * factor)
    assert torch.equal(wide.scales[~split], plain.scales[~split])
    assert torch.equal(wide.means, plain.means)


def test_what_cannot_be_seen_is_pruned() -> None:
    whole = plate()
    opacities = whole.opacities.clone()
    opacities[:10] = 0.01
    detail = split_object(whole._replace(opacities=opacities), 2, 0.05)
    assert len(detail().means) == 4 * (len(opacities) - 10)


def test_parts_are_as_free_as_what_they_were() -> None:
    whole = plate()
    freedom = torch.linspace(0.0, 1.0, len(whole.means))
    whole = whole._replace(opacities=torch.where(torch.arange(len(freedom)) < 10, 0.01, whole.opacities))
    detail = split_object(whole, 2, 0.05, freedom)
    torch.testing.assert_close(detail.freedom, freedom[10:].repeat_interleave(4))
    assert (split_object(whole, 2, 0.05).freedom == 1.0).all()


def test_what_is_released_stays_and_can_move() -> None:
    detail = split_object(plate(), 1, 0.0, torch.full((64,), 0.25))
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for residual in detail.parameters():
            residual += 0.1 * torch.randn(residual.shape, generator=generator)
    before, chosen = detail(), torch.arange(64) < 20
    kept = {name: value[~chosen].clone() for name, value in detail.state_dict().items()}
    detail.release(chosen)
    after = detail()
    for name in ("means", "scales", "opacities", "colors"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name))
    for name, value in detail.state_dict().items():
        assert torch.equal(value[~chosen], kept[name]), name
    with torch.no_grad():
        detail.shift += 0.001
    moved = (detail().means - before.means).norm(dim=-1)
    torch.testing.assert_close(moved, torch.where(chosen, 0.001, 0.00025), atol=1e-6, rtol=0)


def test_an_object_does_not_vanish() -> None:
    with pytest.raises(InputError, match=r"least_opacity: expected 0\.950, .*found 0\.99"):
        split_object(plate(), 2, 0.99)


def test_parameters_do_what_they_are_called() -> None:
    detail = split_object(plate(), 1, 0.0)
    start = detail()
    with torch.no_grad():
        detail.shift[3], detail.size[4, 0], detail.opacity[5], detail.color[6, 1] = 0.002, 2.0, 1.0, -1.0
    now = detail()
    torch.testing.assert_close(now.means[3] - start.means[3], torch.tensor([0.0, 0.0, -0.002]))
    torch.testing.assert_close(now.scales[4, 0] / start.scales[4, 0], torch.tensor(2.0).exp())
    assert now.opacities[5] > start.opacities[5] and now.colors[6, 1] < start.colors[6, 1]
    unchanged = torch.ones(len(start.means), dtype=torch.bool)
    unchanged[3:7] = False
    for before, after in zip(start, now, strict=True):
        assert torch.equal(before[unchanged], after[unchanged])


def test_all_parameters_learn() -> None:
    detail = split_object(plate(), 2, 0.0)
    obj = detail()
    K = torch.tensor([[300.0, 0.0, 32.0], [0.0, 300.0, 32.0], [0.0, 0.0, 1.0]])
    parts = (obj.means, obj.quats, obj.scales, obj.opacities, obj.colors)
    rasterization(*parts, torch.eye(4)[None], K[None], 64, 64).colors.square().sum().backward()
    for name, parameter in detail.named_parameters():
        assert parameter.grad.abs().max() > 0, name


def test_an_empty_room_takes_a_state() -> None:
    detail = split_object(plate(), 2, 0.0)
    room = ObjectDetail(len(detail.shift))
    room.load_state_dict(detail.state_dict())
    assert torch.equal(room().means, detail().means)

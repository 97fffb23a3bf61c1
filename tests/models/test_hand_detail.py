"""Hands without a field: the same hand at first, then Gaussians of their own that follow the same bones."""

from __future__ import annotations

import pytest
import torch
from posed_hands import pose_hand

from bigs.models.hand_detail import HandDetail, free_hand
from bigs.models.hand_splats import HandSplats, HandSplatsConfig
from bigs.models.poses import HandFrames


@pytest.fixture
def field(both_hands) -> HandSplats:
    torch.manual_seed(0)
    splats = HandSplats(both_hands["right"], HandSplatsConfig(subdivisions=0))
    with torch.no_grad():  # a field that says something
        for parameter in splats.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    return splats


def test_a_freed_hand_is_the_same_hand(field: HandSplats) -> None:
    before, after = field(), free_hand(field)()
    for name, value in before._asdict().items():
        if value is None:
            assert getattr(after, name) is None
        else:
            torch.testing.assert_close(getattr(after, name), value, atol=1e-5, rtol=1e-4)
            assert (
                name in ("points", "scales", "opacities", "colors") or not getattr(after, name).requires_grad
            )


def test_it_follows_shape_and_bones_as_before(field: HandSplats) -> None:
    generator = torch.Generator().manual_seed(1)
    turns = torch.linalg.qr(torch.randn(2, 15, 3, 3, generator=generator))[0]
    turns = turns * torch.linalg.det(turns)[..., None, None]
    frames = HandFrames(torch.eye(3).repeat(2, 1, 1), turns, torch.randn(2, 3, generator=generator))
    betas = torch.randn(10, generator=generator)
    posed = [pose_hand(field.model, hand, betas, frames, "left") for hand in (field(), free_hand(field)())]
    torch.testing.assert_close(posed[1].means, posed[0].means, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(posed[1].quats, posed[0].quats, atol=1e-5, rtol=1e-5)


def test_a_shift_goes_along_the_thin_axis(field: HandSplats) -> None:
    detail = free_hand(field)
    before = detail().points
    with torch.no_grad():
        detail.shift[7] = 0.001
    moved = detail().points - before
    torch.testing.assert_close(moved[7], 0.001 * detail.normals[7], atol=1e-7, rtol=1e-3)
    torch.testing.assert_close(moved[7].norm(), torch.tensor(0.001), atol=1e-6, rtol=1e-3)
    assert not moved[:7].any() and not moved[8:].any()


def test_what_hardly_shows_stays_as_its_field_made_it(field: HandSplats) -> None:
    freedom = torch.ones(len(field().points))
    freedom[:5], freedom[5] = 0.0, 0.5
    detail = free_hand(field, freedom)
    before = detail()
    with torch.no_grad():
        for parameter in (detail.shift, detail.size, detail.opacity, detail.color):
            parameter.fill_(0.01)
    after = detail()
    for name in ("points", "scales", "opacities", "colors"):
        moved = (getattr(after, name) - getattr(before, name)).abs().reshape(len(freedom), -1).amax(1)
        assert not moved[:5].any() and (moved[5:] > 0.0).all(), name
    torch.testing.assert_close((after.scales / before.scales)[5].log(), torch.full((3,), 0.005))
    after.colors.sum().backward()
    assert not detail.color.grad[:5].any() and detail.color.grad[5:].any()


def test_no_gaussian_of_a_hand_grows_without_end(field: HandSplats) -> None:
    """Below a sleeve nothing forbids it, and it would show as a ray."""
    detail = free_hand(field)
    start = detail()
    with torch.no_grad():
        detail.size[0], detail.size[1], detail.size[2] = 1.5, 4.0, -4.0
    grown = detail().scales
    growth = (grown / start.scales)[:3].log()
    torch.testing.assert_close(growth, torch.tensor([[1.5], [1.6], [-4.0]]).expand(3, 3))
    grown.sum().backward()
    assert detail.size.grad[:3].bool().all(-1).tolist() == [True, False, True]
    before = detail()
    detail.release(torch.arange(len(detail.size)) < 3)
    torch.testing.assert_close(detail().scales, before.scales)


def test_freed_twice_is_freed_once(field: HandSplats) -> None:
    once = free_hand(field)
    with torch.no_grad():
        once.color.add_(0.3)
    twice = free_hand(once)
    assert isinstance(twice, HandDetail) and not twice.color.any()
    torch.testing.assert_close(twice().colors, once().colors)

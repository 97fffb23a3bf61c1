import pytest
import torch

from bigs.losses.contact import center_contact, deepest_mean, penetration, surface_contact


def test_center_contact_is_the_mean_distance_while_touching() -> None:
    centers = torch.tensor([[0.0, 0.0, 1.0], [0.3, 0.0, 1.0], [9.0, 9.0, 9.0]])
    wrists = torch.tensor([[0.0, 0.1, 1.0], [0.0, 0.4, 1.0], [0.0, 0.0, 0.0]])
    touching = torch.tensor([1.0, 1.0, 0.0])
    assert center_contact(centers, wrists, touching).item() == pytest.approx((0.1 + 0.5) / 2)
    assert center_contact(centers, wrists, torch.zeros(3)) == 0.0


def test_deepest_mean_takes_the_smallest_signed_values() -> None:
    distances = torch.tensor([[0.5, -0.2, 0.001, -0.1], [0.4, 0.3, 0.2, 0.1]])
    torch.testing.assert_close(deepest_mean(distances, 2), torch.tensor([-0.15, 0.15]))
    torch.testing.assert_close(deepest_mean(distances, 99), distances.mean(1))


def vertices(nearest: float, count: int = 8) -> torch.Tensor:
    """Distances [1, V]: `count` vertices at `nearest`, the rest of a hand 5 cm away."""
    values = torch.full((1, 40), 0.05, dtype=torch.float64)
    values[:, :count] = nearest
    return values.requires_grad_()


def gradient(distances: torch.Tensor, function) -> torch.Tensor:
    return torch.autograd.grad(function(distances), distances)[0]


def test_contact_pulls_a_hovering_hand_in_and_pushes_a_sunken_one_out() -> None:
    def loss(d: torch.Tensor) -> torch.Tensor:
        return surface_contact(d, torch.ones(1), count=8)

    assert loss(vertices(0.0)) == 0.0
    assert loss(vertices(0.01)).item() == pytest.approx(0.5)
    assert loss(vertices(-0.01)).item() == pytest.approx(0.5)
    hovering, sunken = gradient(vertices(0.004), loss), gradient(vertices(-0.004), loss)
    assert (hovering[:, :8] > 0).all() and (sunken[:, :8] < 0).all()
    assert not hovering[:, 8:].any() and not sunken[:, 8:].any()


def test_contact_saturates_and_asks_only_where_the_image_shows_touch() -> None:
    touching = torch.tensor([1.0, 0.0], dtype=torch.float64)
    both = torch.cat([vertices(0.01), vertices(0.5)])
    assert surface_contact(both, touching, count=8).item() == pytest.approx(0.5)
    assert surface_contact(both, 1.0 - touching, count=8) < 1.0
    assert surface_contact(both, torch.zeros(2)) == 0.0


def test_penetration_is_squared_centimetres_beyond_the_tolerance() -> None:
    distances = torch.tensor([[0.0, 0.02, -0.001, -0.011], [0.1, 0.1, 0.1, -0.031]])
    assert penetration(distances).item() == pytest.approx((1.0 + 9.0) / 2, rel=1e-5)
    assert penetration(distances.abs()) == 0.0


def test_penetration_pushes_outwards_and_lets_the_outside_be() -> None:
    def loss(d: torch.Tensor) -> torch.Tensor:
        return penetration(d)

    inside = gradient(vertices(-0.01), loss)
    assert (inside[:, :8] < 0).all() and not inside[:, 8:].any()
    assert not gradient(vertices(0.01), loss).any()
    assert not gradient(vertices(-0.0005), loss).any()


def test_gradients() -> None:
    generator = torch.Generator().manual_seed(0)
    distances = 0.02 * torch.randn(3, 12, generator=generator, dtype=torch.float64)
    touching = torch.tensor([1.0, 0.0, 0.5], dtype=torch.float64)
    assert torch.autograd.gradcheck(penetration, distances.requires_grad_())
    assert torch.autograd.gradcheck(lambda d: surface_contact(d, touching, count=4), distances, eps=1e-7)
    centers, wrists = torch.randn(2, 3, 3, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda c, w: center_contact(c, w, touching), (centers, wrists))
    # A wrist exactly in the centre must not poison the step.
    same = torch.zeros(1, 3, requires_grad=True)
    center_contact(same, torch.zeros(1, 3), torch.ones(1)).backward()
    assert same.grad.isfinite().all()

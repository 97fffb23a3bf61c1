import pytest
import torch

from bigs.losses.contact import center_contact, fingers_on_surface, penetration, surface_contact


def test_center_contact_is_the_mean_distance_while_touching() -> None:
    centers = torch.tensor([[0.0, 0.0, 1.0], [0.3, 0.0, 1.0], [9.0, 9.0, 9.0]])
    wrists = torch.tensor([[0.0, 0.1, 1.0], [0.0, 0.4, 1.0], [0.0, 0.0, 0.0]])
    touching = torch.tensor([1.0, 1.0, 0.0])
    assert center_contact(centers, wrists, touching).item() == pytest.approx((0.1 + 0.5) / 2)
    assert center_contact(centers, wrists, torch.zeros(3)) == 0.0


def depths(*values: float) -> torch.Tensor:
    """How deep a hand reaches in each frame, metres."""
    return torch.tensor(values, dtype=torch.float64, requires_grad=True)


def test_contact_pulls_a_hovering_hand_in_and_pushes_a_sunken_one_out() -> None:
    def loss(d: torch.Tensor) -> torch.Tensor:
        return surface_contact(d, torch.ones(1))

    assert loss(depths(0.0)) == 0.0
    assert loss(depths(0.01)).item() == pytest.approx(0.5)
    assert loss(depths(-0.01)).item() == pytest.approx(0.5)
    for side in (1.0, -1.0):
        depth = depths(0.004 * side)
        (pull,) = torch.autograd.grad(loss(depth), depth)
        assert pull.item() * side > 0


def test_contact_saturates_and_asks_only_where_the_image_shows_touch() -> None:
    touching = torch.tensor([1.0, 0.0], dtype=torch.float64)
    both = depths(0.01, 0.5)
    assert surface_contact(both, touching).item() == pytest.approx(0.5)
    assert surface_contact(both, 1.0 - touching) < 1.0
    assert surface_contact(both, torch.zeros(2)) == 0.0


def test_each_finger_is_drawn_by_itself_while_the_hand_holds() -> None:
    fingers = torch.tensor([[0.0, 0.01], [-0.03, 0.5]], dtype=torch.float64, requires_grad=True)
    holding = torch.tensor([1.0, 0.0], dtype=torch.float64)
    loss = fingers_on_surface(fingers, holding)
    assert loss.item() == pytest.approx(0.25)
    (pull,) = torch.autograd.grad(loss, fingers)
    assert pull[0, 1] > 0 and pull[0, 0] == 0 and not pull[1].any()
    # A hand that reaches the surface as a whole is no reason for a finger to stand off.
    assert surface_contact(fingers.detach()[:, 0], holding) == 0.0
    # A finger that is far off is hardly drawn, and a doubtful grasp as far as it is sure.
    (far,) = torch.autograd.grad(fingers_on_surface(fingers, torch.tensor([0.0, 0.5])), fingers)
    assert 0 < far[1, 1] < 0.02 * pull[0, 1] and far[1, 0] < 0
    assert fingers_on_surface(fingers, torch.zeros(2)) == 0.0
    assert fingers_on_surface(fingers[:, :0], holding) == 0.0


def test_penetration_is_in_squared_centimetres() -> None:
    assert penetration(torch.tensor([1e-4, 9e-4])).item() == pytest.approx((1.0 + 9.0) / 2, rel=1e-5)
    assert penetration(torch.zeros(2)) == 0.0


def test_gradients() -> None:
    generator = torch.Generator().manual_seed(0)
    sunk = torch.rand(3, generator=generator, dtype=torch.float64)
    touching = torch.tensor([1.0, 0.0, 0.5], dtype=torch.float64)
    assert torch.autograd.gradcheck(penetration, sunk.requires_grad_())
    assert torch.autograd.gradcheck(
        lambda d: surface_contact(d, touching), depths(0.01, -0.02, 0.3), eps=1e-7
    )
    fingers = depths(0.01, -0.02, 0.3, 0.02, 0.005, -0.001).reshape(3, 2)
    assert torch.autograd.gradcheck(lambda d: fingers_on_surface(d, touching), fingers, eps=1e-7)
    centers, wrists = torch.randn(2, 3, 3, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda c, w: center_contact(c, w, touching), (centers, wrists))
    # A wrist exactly in the centre must not poison the step.
    same = torch.zeros(1, 3, requires_grad=True)
    center_contact(same, torch.zeros(1, 3), torch.ones(1)).backward()
    assert same.grad.isfinite().all()

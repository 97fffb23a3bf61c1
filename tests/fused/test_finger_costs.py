"""What finger joints cost: compiled against the same in torch."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from bigs.fused.fingers import FingerCosts, finger_costs
from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.hand import HandModel, bends, builtin_hand, impossible_turns


@pytest.fixture(scope="module")
def right() -> HandModel:
    return builtin_hand("right").double()


def twin(hand_pose: Tensor, turns: Tensor, bends: Tensor) -> FingerCosts:
    fingers = hand_pose.reshape(len(hand_pose), 5, -1)
    # MANO's fingers: index, middle, pinky, ring and thumb.
    across = hand_pose.new_tensor([[1.0, -2.0, 0.0, 1.0, 0.0], [0.0, 1.0, 1.0, -2.0, 0.0]]) @ fingers
    sine, cosine = torch.einsum("bjkl,spfjkl->sbpf", hand_pose, bends)
    middle, outer = torch.atan2(sine, cosine).unbind(1)
    away = (outer - 2.0 / 3.0 * middle) / 0.15
    return FingerCosts(
        0.5 * across.square().sum() / (len(hand_pose) * 2 * 3),
        torch.einsum("bjkl,mjkl->bm", hand_pose, turns).square().mean(),
        2.0 * 0.15**2 * ((1.0 + away.square()).sqrt() - 1.0).mean(),
    )


def poses(count: int, bend: float, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(count)
    vectors = bend * torch.randn(count, 15, 3, generator=generator, dtype=torch.float64)
    return axis_angle_to_matrix(vectors).to(dtype)


def known(hand: HandModel, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    return impossible_turns(hand).to(dtype), bends(hand).to(dtype)


@pytest.mark.parametrize("count", [1, 7])
@pytest.mark.parametrize("bend", [0.05, 0.8, 3.0])
def test_values_and_gradients_are_those_of_torch(right: HandModel, count: int, bend: float) -> None:
    pose, shown = poses(count, bend), poses(count, bend)
    found = finger_costs(pose.requires_grad_(), *known(right))
    expected = twin(shown.requires_grad_(), *known(right))
    for weight, ours, theirs in zip((0.3, -2.0, 0.7), found, expected, strict=True):
        assert ours.item() == pytest.approx(theirs.item(), rel=1e-12)
        (weight * ours).backward(retain_graph=True)
        (weight * theirs).backward(retain_graph=True)
    torch.testing.assert_close(pose.grad, shown.grad, rtol=1e-11, atol=1e-13)


def test_any_linear_functions_are_taken() -> None:
    """Not only those that look at one joint."""
    generator = torch.Generator().manual_seed(0)
    turns, bends = (
        torch.randn(*shape, 15, 3, 3, generator=generator, dtype=torch.float64) for shape in ((3,), (2, 2, 4))
    )
    for ours, theirs in zip(
        finger_costs(poses(4, 0.5), turns, bends), twin(poses(4, 0.5), turns, bends), strict=True
    ):
        assert ours.item() == pytest.approx(theirs.item(), rel=1e-12)


def test_gradients_are_exact(right: HandModel) -> None:
    def costs(pose: Tensor) -> tuple[Tensor, ...]:
        return finger_costs(pose, *known(right))

    assert torch.autograd.gradcheck(costs, poses(3, 0.4).requires_grad_())


def test_fingers_are_even_if_each_is_the_mean_of_its_neighbours(right: HandModel) -> None:
    """Index, middle, ring and pinky lie side by side, although MANO lists the pinky before the ring."""

    def unevenness(vectors: Tensor) -> float:
        return finger_costs(axis_angle_to_matrix(vectors), *known(right)).unevenness.item()

    bent = torch.zeros(2, 15, 3, dtype=torch.float64)
    bent[..., 2] = 0.5
    assert unevenness(bent) == pytest.approx(0.0, abs=1e-12)
    for joint, squares in ((1, 1), (4, 5), (10, 5), (7, 1), (13, 0)):
        one = bent.clone()
        one[:, joint, 2] += 0.1
        assert unevenness(one) == pytest.approx(squares * 2.0 * (1.0 - math.cos(0.1)) / 6.0, abs=1e-12)


def test_single_precision_is_kept(right: HandModel) -> None:
    pose = poses(60, 0.5, torch.float32).requires_grad_()
    found = finger_costs(pose, *known(right, torch.float32))
    sum(found, torch.zeros(())).backward()
    assert {cost.dtype for cost in found} == {pose.grad.dtype} == {torch.float32}
    exact = twin(poses(60, 0.5), *known(right))
    for ours, theirs in zip(found, exact, strict=True):
        assert ours.item() == pytest.approx(theirs.item(), rel=1e-5)


def test_a_joint_without_an_angle_has_no_gradient(right: HandModel) -> None:
    """Where sine and cosine are both 0; torch would say NaN."""
    pose = torch.zeros(1, 15, 3, 3, dtype=torch.float64, requires_grad=True)
    finger_costs(pose, *known(right)).uncoupled.backward()
    assert pose.grad.abs().max() == 0.0


def test_no_poses_cost_nothing(right: HandModel) -> None:
    costs = finger_costs(torch.zeros(0, 15, 3, 3, dtype=torch.float64), *known(right))
    assert [cost.item() for cost in costs] == [0.0, 0.0, 0.0]


def test_what_is_not_finite_shows(right: HandModel) -> None:
    pose = poses(2, 0.3)
    pose[1, 4, 0, 0] = torch.nan
    assert all(cost.isnan() for cost in finger_costs(pose, *known(right)))


def test_wrong_lengths_are_refused(right: HandModel) -> None:
    turns, bends = known(right)
    with pytest.raises(ValueError, match="bends"):
        finger_costs(poses(1, 0.1), turns, bends[:, :, :3])
    with pytest.raises(ValueError, match="hand_pose"):
        finger_costs(poses(1, 0.1)[:, :14], turns, bends)

"""Turns that finger joints cannot make: none in a pose of hinges, the sine of the angle in any other."""

import math

import pytest
import torch

from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.hand import HandModel, impossible_turns
from bigs.losses.regularizers import impossible_turn

# Joints of MANO's fingers (index, middle, pinky, ring) that are hinges, and all that must not twist.
HINGES = [3 * finger + place for finger in range(4) for place in (1, 2)]
NO_TWIST = [*range(12), 13, 14]


@pytest.fixture(params=["right", "left"])
def hand(request: pytest.FixtureRequest, right: HandModel) -> HandModel:
    return right if request.param == "right" else right.mirrored()


def bone(hand: HandModel, joint: int) -> torch.Tensor:
    rest = hand.rest_joints(torch.zeros(10, dtype=torch.float64))
    tip = {2: 1, 5: 2, 8: 4, 11: 3, 14: 0}.get(joint)
    end = rest[joint + 2] if tip is None else hand.v_template[hand.tip_vertex_ids[tip]]
    return torch.nn.functional.normalize(end - rest[joint + 1], dim=0)


def across(hand: HandModel, joint: int) -> torch.Tensor:
    """The hinge: horizontal in the flat hand, and at right angles to the bone."""
    along = bone(hand, joint)
    axis = torch.stack([-along[2], torch.zeros(()).double(), along[0]])
    return axis / axis.norm()


def posed(joint: int, turn: torch.Tensor) -> torch.Tensor:
    vectors = torch.zeros(1, 15, 3, dtype=torch.float64)
    vectors[0, joint] = turn
    return axis_angle_to_matrix(vectors)


@pytest.mark.parametrize("angle", [-0.4, 0.3, 1.5])
def test_bending_is_free(hand: HandModel, angle: float) -> None:
    """All hinges by any angle, and the base joints of fingers both ways."""
    vectors = torch.zeros(1, 15, 3, dtype=torch.float64)
    for joint in HINGES:
        vectors[0, joint] = angle * across(hand, joint)
    assert impossible_turn(axis_angle_to_matrix(vectors), impossible_turns(hand)).item() < 1e-13
    for joint in (0, 3, 6, 9):
        for axis in (across(hand, joint), torch.linalg.cross(across(hand, joint), bone(hand, joint))):
            turned = posed(joint, angle * axis)
            assert impossible_turn(turned, impossible_turns(hand)).item() < 1e-13


@pytest.mark.parametrize("joint", NO_TWIST)
def test_twisting_costs_its_squared_sine(hand: HandModel, joint: int) -> None:
    turned = posed(joint, 0.2 * bone(hand, joint))
    rows = len(impossible_turns(hand))
    assert impossible_turn(turned, impossible_turns(hand)).item() * rows == pytest.approx(math.sin(0.2) ** 2)


@pytest.mark.parametrize("joint", HINGES)
def test_a_hinge_that_bends_sideways_costs_its_squared_sine(hand: HandModel, joint: int) -> None:
    aside = torch.linalg.cross(across(hand, joint), bone(hand, joint))
    rows = len(impossible_turns(hand))
    cost = impossible_turn(posed(joint, -0.3 * aside), impossible_turns(hand))
    assert cost.item() * rows == pytest.approx(math.sin(0.3) ** 2)


def test_the_thumbs_saddle_joint_turns_all_ways(hand: HandModel) -> None:
    for axis in torch.eye(3, dtype=torch.float64):
        assert impossible_turn(posed(12, 0.5 * axis), impossible_turns(hand)).item() < 1e-13


def test_it_has_exact_gradients(hand: HandModel) -> None:
    pose = 0.4 * torch.randn(2, 15, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(
        lambda values: impossible_turn(axis_angle_to_matrix(values), impossible_turns(hand)),
        pose.requires_grad_(),
    )

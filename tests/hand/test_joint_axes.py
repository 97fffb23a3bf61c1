"""Turns that finger joints cannot make: none in a pose of hinges, the sine of the angle in any other.

And how far the hinges bend, of which the outer follows the middle one.
"""

import math

import pytest
import torch

from bigs.fused.fingers import finger_costs
from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.hand import HandModel, bends, impossible_turns

# Joints of MANO's fingers (index, middle, pinky, ring) that are hinges, and all that must not twist.
HINGES = [3 * finger + place for finger in range(4) for place in (1, 2)]
NO_TWIST = [*range(12), 13, 14]


@pytest.fixture(params=["right", "left"])
def hand(request: pytest.FixtureRequest, right: HandModel) -> HandModel:
    return right if request.param == "right" else right.mirrored()


def impossible_turn(hand: HandModel, pose: torch.Tensor) -> torch.Tensor:
    return finger_costs(pose, impossible_turns(hand), bends(hand)).impossible


def uncoupled_bending(hand: HandModel, pose: torch.Tensor) -> torch.Tensor:
    return finger_costs(pose, impossible_turns(hand), bends(hand)).uncoupled


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
    assert impossible_turn(hand, axis_angle_to_matrix(vectors)).item() < 1e-13
    for joint in (0, 3, 6, 9):
        for axis in (across(hand, joint), torch.linalg.cross(across(hand, joint), bone(hand, joint))):
            turned = posed(joint, angle * axis)
            assert impossible_turn(hand, turned).item() < 1e-13


@pytest.mark.parametrize("joint", NO_TWIST)
def test_twisting_costs_its_squared_sine(hand: HandModel, joint: int) -> None:
    turned = posed(joint, 0.2 * bone(hand, joint))
    rows = len(impossible_turns(hand))
    assert impossible_turn(hand, turned).item() * rows == pytest.approx(math.sin(0.2) ** 2)


@pytest.mark.parametrize("joint", HINGES)
def test_a_hinge_that_bends_sideways_costs_its_squared_sine(hand: HandModel, joint: int) -> None:
    aside = torch.linalg.cross(across(hand, joint), bone(hand, joint))
    rows = len(impossible_turns(hand))
    cost = impossible_turn(hand, posed(joint, -0.3 * aside))
    assert cost.item() * rows == pytest.approx(math.sin(0.3) ** 2)


def test_the_thumbs_saddle_joint_turns_all_ways(hand: HandModel) -> None:
    for axis in torch.eye(3, dtype=torch.float64):
        assert impossible_turn(hand, posed(12, 0.5 * axis)).item() < 1e-13


def bent(hand: HandModel, angles: dict[int, float]) -> torch.Tensor:
    vectors = torch.zeros(1, 15, 3, dtype=torch.float64)
    for joint, angle in angles.items():
        vectors[0, joint] = angle * across(hand, joint)
    return axis_angle_to_matrix(vectors)


def bending_angles(hand: HandModel, pose: torch.Tensor) -> torch.Tensor:
    """[2, 4] radians of the middle and outermost joints."""
    sine, cosine = torch.einsum("...jab,jab->...", bends(hand), pose[0])
    return torch.atan2(sine, cosine)


@pytest.mark.parametrize("angle", [-1.9, -0.4, 0.3, 1.5, 2.5])
@pytest.mark.parametrize("joint", HINGES)
def test_a_hinge_bends_by_its_angle_and_no_other_bends(hand: HandModel, joint: int, angle: float) -> None:
    finger, place = divmod(joint, 3)
    angles = bending_angles(hand, bent(hand, {joint: angle}))
    # MANO's hands bend about `across` or against it; the sign is the same for all their fingers.
    assert angles[place - 1, finger].abs().item() == pytest.approx(abs(angle))
    angles[place - 1, finger] = 0.0
    assert angles.abs().max() < 1e-12


@pytest.mark.parametrize("angle", [-0.3, 0.5, 1.7])
def test_fingers_that_follow_their_tendons_cost_nothing(hand: HandModel, angle: float) -> None:
    """However their base joints bend and spread, and however a thumb bends."""
    angles = {0: 0.7, 6: -0.2, 13: 0.5, 14: -0.9}
    for finger in range(4):
        angles |= {3 * finger + 1: angle, 3 * finger + 2: angle * 2.0 / 3.0}
    pose = bent(hand, angles)
    assert uncoupled_bending(hand, pose).item() < 1e-12


def test_a_tip_that_is_pressed_back_costs_like_its_angle(hand: HandModel) -> None:
    """A little departure costs its square, a large one less."""

    def cost(away: float) -> float:
        pose = bent(hand, {1: 0.6, 2: 0.4 + away, 4: 0.0, 5: 0.0})
        return 4.0 * uncoupled_bending(hand, pose).item()

    assert cost(0.01) == pytest.approx(0.01**2, rel=0.01)
    assert cost(-0.01) == pytest.approx(cost(0.01), rel=1e-6)
    assert cost(1.0) == pytest.approx(2.0 * (math.sqrt(1.0 + (1.0 / 0.15) ** 2) - 1.0) * 0.15**2)
    assert cost(1.0) - cost(0.8) == pytest.approx(cost(0.8) - cost(0.6), rel=0.02)

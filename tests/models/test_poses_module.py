"""Residual poses: their start, what each residual does, and what it leaves alone."""

import math

import pytest
import torch
from small_scene import rotations

from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.models.poses import (
    USUAL_RAY,
    USUAL_TURN,
    HandPoses,
    ObjectPoses,
    PoseErrors,
    RayPositions,
)

T = 5
POSITIONS = torch.tensor([0.1, -0.2, 0.6]) + 0.1 * torch.rand(
    T, 3, generator=torch.Generator().manual_seed(0)
)
ALL = torch.arange(T)


def test_fresh_positions_are_the_given_ones_in_the_order_asked_for() -> None:
    frames = torch.tensor([3, 0, 3])
    torch.testing.assert_close(RayPositions(POSITIONS)(frames), POSITIONS[frames])


def test_a_step_in_log_depth_moves_along_the_ray_by_a_fraction() -> None:
    positions = RayPositions(POSITIONS)
    with torch.no_grad():
        positions.log_depth[2] = math.log(1.1)
    moved = positions(ALL)
    torch.testing.assert_close(moved[2], 1.1 * POSITIONS[2])
    torch.testing.assert_close(moved[[0, 1, 3, 4]], POSITIONS[[0, 1, 3, 4]])


def test_a_step_along_the_image_keeps_the_depth() -> None:
    positions = RayPositions(POSITIONS)
    with torch.no_grad():
        positions.ray[1] = torch.tensor([0.01, -0.02])
    torch.testing.assert_close(
        positions(ALL)[1], POSITIONS[1] + POSITIONS[1, 2] * torch.tensor([0.01, -0.02, 0.0])
    )


def test_gradients_reach_only_the_frames_that_were_asked_for() -> None:
    positions = RayPositions(POSITIONS)
    positions(torch.tensor([1, 3])).sum().backward()
    assert (positions.log_depth.grad != 0).tolist() == [False, True, False, True, False]
    assert positions.ray.grad[[0, 2, 4]].abs().max() == 0 < positions.ray.grad[[1, 3]].abs().min()


@pytest.fixture
def hand() -> HandPoses:
    return HandPoses(rotations(T, seed=1), rotations(T, 15, seed=2), POSITIONS)


def test_fresh_hand_poses_are_the_given_ones(hand: HandPoses) -> None:
    pose = hand(ALL)
    torch.testing.assert_close(pose.global_orient, rotations(T, seed=1))
    torch.testing.assert_close(pose.hand_pose, rotations(T, 15, seed=2))
    torch.testing.assert_close(pose.wrist, POSITIONS)


def test_hand_residuals_turn_the_wrist_in_camera_space_and_fingers_in_their_own(hand: HandPoses) -> None:
    turn, bend, bias = torch.tensor([[0.3, 0, 0], [0, 0.2, 0], [0, 0, -0.1]])
    with torch.no_grad():
        hand.orient[2], hand.pose[2, 4], hand.pose_bias[4] = turn, bend, bias
    pose = hand(ALL)
    torch.testing.assert_close(pose.global_orient[2], axis_angle_to_matrix(turn) @ rotations(T, seed=1)[2])
    start = rotations(T, 15, seed=2)
    torch.testing.assert_close(pose.hand_pose[2, 4], start[2, 4] @ axis_angle_to_matrix(bend + bias))
    # The bias is every frame's.
    torch.testing.assert_close(pose.hand_pose[0, 4], start[0, 4] @ axis_angle_to_matrix(bias))
    torch.testing.assert_close(pose.hand_pose[:, 5:], start[:, 5:])


def test_rotations_learn_from_exactly_zero(hand: HandPoses) -> None:
    generator = torch.Generator().manual_seed(3)
    pose = hand(ALL)
    loss = (pose.hand_pose * torch.randn(pose.hand_pose.shape, generator=generator)).sum()
    (loss + (pose.global_orient * torch.randn(T, 3, 3, generator=generator)).sum()).backward()
    for parameter in (hand.orient, hand.pose, hand.pose_bias):
        assert parameter.grad.isfinite().all() and (parameter.grad != 0).all()


def test_object_scale_multiplies_size_and_depth() -> None:
    poses = ObjectPoses(rotations(T, seed=1), POSITIONS)
    fresh = poses(ALL)
    assert fresh.scale == 1.0
    torch.testing.assert_close(fresh.centers, POSITIONS)
    torch.testing.assert_close(fresh.rotations, rotations(T, seed=1))
    with torch.no_grad():
        poses.log_scale.fill_(math.log(1.25))
        poses.orient[0] = torch.tensor([0.0, 0.0, 0.5])
    grown = poses(ALL)
    torch.testing.assert_close(grown.scale, torch.tensor(1.25))
    torch.testing.assert_close(grown.centers, 1.25 * POSITIONS)
    torch.testing.assert_close(
        grown.rotations[0], axis_angle_to_matrix(torch.tensor([0.0, 0.0, 0.5])) @ rotations(T, seed=1)[0]
    )


def test_gradients_of_both_modules(hand: HandPoses) -> None:
    frames = torch.tensor([0, 2])

    def check(module: torch.nn.Module) -> None:
        module.double()
        names = [name for name, _ in module.named_parameters()]

        def run(*values: torch.Tensor) -> tuple:
            return tuple(torch.func.functional_call(module, dict(zip(names, values, strict=True)), (frames,)))

        generator = torch.Generator().manual_seed(4)
        values = [0.2 * torch.randn(p.shape, generator=generator).double() for p in module.parameters()]
        assert torch.autograd.gradcheck(run, [v.requires_grad_() for v in values], fast_mode=True)

    check(hand)
    check(ObjectPoses(rotations(T, seed=1), POSITIONS))


def test_residuals_of_poses_known_better_count_less() -> None:
    turn = torch.stack(
        [torch.diag(torch.tensor([0.1, 0.5, 1.0])) * USUAL_TURN, 4.0 * USUAL_TURN * torch.eye(3)]
    )
    poses = ObjectPoses(
        rotations(2, seed=1), POSITIONS[:2], PoseErrors(turn, torch.tensor([0.25, 9.0]) * USUAL_RAY)
    )
    with torch.no_grad():
        poses.orient[:] = torch.tensor([0.1, 0.2, 0.3])
        poses.position.ray[:] = torch.tensor([0.02, 0.0])
    found = poses(torch.arange(2))
    for t, residual in enumerate(([0.01, 0.1, 0.3], [0.1, 0.2, 0.3])):
        expected = axis_angle_to_matrix(torch.tensor(residual)) @ rotations(2, seed=1)[t]
        torch.testing.assert_close(found.rotations[t], expected)
    moved = found.centers[:, 0] - POSITIONS[:2, 0]
    torch.testing.assert_close(moved, torch.tensor([0.005, 0.02]) * POSITIONS[:2, 2])
    # The prior counts both in errors; of a start that nobody measured only the turn.
    assert poses.departures().shape == (2, 5)
    torch.testing.assert_close(poses.departures()[0, 3], torch.tensor(0.02 * USUAL_TURN / USUAL_RAY))
    assert ObjectPoses(rotations(2, seed=1), POSITIONS[:2]).departures().shape == (2, 3)

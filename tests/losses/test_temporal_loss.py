import math

import pytest
import torch

from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.losses.temporal import acceleration, pose_steps, velocity

T, N = 6, 4


def motion(degree: int) -> torch.Tensor:
    """Points [T, N, 3] that move as t ** degree."""
    generator = torch.Generator().manual_seed(degree)
    start, slope = torch.randn(2, N, 3, generator=generator, dtype=torch.float64)
    return start + slope * torch.arange(T).double()[:, None, None] ** degree


def test_uniform_motion_has_no_acceleration() -> None:
    assert acceleration(motion(0)) == 0.0
    assert acceleration(motion(1)) < 1e-20
    assert acceleration(motion(2)) > 1.0


def test_acceleration_is_in_centimetres_per_frame_squared() -> None:
    points = torch.zeros(3, 2, 3)
    points[1, 0, 1] = 0.01  # 1 cm away for one frame: the second difference is 2 cm
    assert acceleration(points).item() == pytest.approx(0.5 * 2.0**2)
    fall = 0.5 * 0.03 * torch.arange(T)[:, None, None] ** 2 * torch.ones(1, N, 1) * torch.eye(3)[0]
    assert acceleration(fall).item() == pytest.approx(9.0, rel=1e-4)


def test_pose_steps_of_a_steady_turn_is_the_angle_squared() -> None:
    """L_smt: joints turn by 0.02 and 0.05 a frame, the wrist steps by 3 and 4 mm."""
    axis = torch.nn.functional.normalize(torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64), dim=0)
    angles = torch.arange(T).double()[:, None] * torch.tensor([0.02, 0.05])
    rotations = axis_angle_to_matrix(angles[..., None] * axis)
    positions = torch.arange(T).double()[:, None] * torch.tensor([0.003, 0.0, 0.004])
    exact = sum(4.0 - 4.0 * math.cos(a) for a in (0.02, 0.05)) / 2.0 + 0.005**2
    assert pose_steps(rotations, positions).item() == pytest.approx(exact)
    assert exact == pytest.approx(0.02**2 + 0.05**2 + 0.005**2, rel=1e-3)


def test_pose_steps_know_no_jump_at_half_a_turn() -> None:
    angles = torch.tensor([math.pi - 0.01, math.pi + 0.01], dtype=torch.float64)
    rotations = axis_angle_to_matrix(angles[:, None, None] * torch.eye(3).double()[:1])
    assert pose_steps(rotations, torch.zeros(2, 3)).item() == pytest.approx(0.02**2, rel=1e-3)


def test_velocity_counts_the_pairs_in_which_the_object_is_held() -> None:
    points = torch.zeros(4, N, 3)
    points[1:, :, 0] = 0.02  # 2 cm between frames 0 and 1
    points[3, :, 2] = 0.01  # 1 cm between frames 2 and 3
    assert velocity(points, torch.tensor([0.0, 1.0, 1.0])).item() == pytest.approx(0.5)
    assert velocity(points, torch.tensor([1.0, 1.0, 0.0])).item() == pytest.approx(2.0)
    assert velocity(points, torch.zeros(3)) == 0.0


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_clips_too_short_to_differ_cost_nothing_but_keep_the_graph(frames: int) -> None:
    points = torch.randn(frames, N, 3, requires_grad=True)
    assert acceleration(points) == 0.0
    acceleration(points).backward()
    if frames < 2:
        assert velocity(points, torch.zeros(0)) == 0.0
        assert pose_steps(torch.eye(3).expand(frames, 5, 3, 3), points[:, 0]) == 0.0
    assert not points.grad.any()


def test_gradients() -> None:
    points = motion(2).requires_grad_()
    together = torch.tensor([0.0, 1.0, 0.5, 1.0, 0.0], dtype=torch.float64)
    assert torch.autograd.gradcheck(acceleration, points)
    assert torch.autograd.gradcheck(lambda p: velocity(p, together), points)
    rotations = torch.randn(T, 2, 3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(pose_steps, (rotations, points.detach()[:, 0].requires_grad_()))

"""Local-linear smoothing: what is linear stays, what is noise or an outlier goes."""

import pytest
import torch

from bigs.geometry.rotations import axis_angle_to_matrix, rotation_angle
from bigs.geometry.smoothing import interpolated_frames, smooth_rotations, smooth_vectors

T = 40
AXIS = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64), dim=0)


def line(slope: float = 0.01) -> torch.Tensor:
    """Positions [T, 3] of a uniform motion."""
    return torch.tensor([0.1, -0.2, 0.5]).double() + slope * torch.arange(T).double()[:, None] * AXIS


def noise(amount: float, seed: int = 0) -> torch.Tensor:
    return amount * torch.randn(T, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def turning() -> torch.Tensor:
    """Rotations [T, 3, 3] at a constant rate, through more than half a turn."""
    return axis_angle_to_matrix((0.3 + 0.1 * torch.arange(T).double()[:, None]) * AXIS)


@pytest.mark.parametrize("sigma", [0.8, 2.0, 5.0])
def test_uniform_motion_stays_as_it_is_to_the_very_ends(sigma: float) -> None:
    weights = torch.linspace(0.2, 1.0, T).double()
    torch.testing.assert_close(smooth_vectors(line(), weights, sigma), line(), atol=1e-10, rtol=0)


def test_uniform_rotation_stays_as_it_is() -> None:
    smooth = smooth_rotations(turning(), torch.ones(T).double(), 2.0)
    torch.testing.assert_close(smooth, turning(), atol=1e-8, rtol=0)


def test_no_width_means_no_smoothing() -> None:
    noisy, rotations = line() + noise(0.01), turning()
    assert smooth_vectors(noisy, torch.ones(T).double(), 0.0) is noisy
    assert smooth_rotations(rotations, torch.ones(T).double(), 0.0) is rotations
    assert smooth_vectors(noisy[:2], torch.ones(2).double(), 3.0).equal(noisy[:2])


def test_noise_shrinks_as_the_window_promises() -> None:
    smooth = smooth_vectors(line() + noise(0.01), torch.ones(T).double(), 3.0)
    inner = slice(8, -8)
    # Gaussian weights of sigma 3 average over 2 sqrt(pi) sigma = 10.6 frames.
    assert (smooth - line())[inner].square().mean().sqrt() < 0.45 * 0.01


def test_an_outlier_leaves_no_trace() -> None:
    clean = line() + noise(0.001)
    broken = clean.clone()
    broken[17] += torch.tensor([0.5, -0.3, 0.2])
    ones = torch.ones(T).double()
    smooth = smooth_vectors(broken, ones, 2.0)
    assert (smooth - line()).norm(dim=-1).max() < 0.004
    # As if the frame had never been measured.
    without = ones.clone()
    without[17] = 0.0
    torch.testing.assert_close(smooth, smooth_vectors(clean, without, 2.0), atol=5e-4, rtol=0)


def test_a_flipped_rotation_leaves_no_trace() -> None:
    wobble = axis_angle_to_matrix(noise(0.005, seed=2))
    broken = turning() @ wobble
    broken[20] = broken[20] @ axis_angle_to_matrix(torch.tensor([2.5, 0.0, 0.0], dtype=torch.float64))
    smooth = smooth_rotations(broken, torch.ones(T).double(), 2.0)
    assert rotation_angle(smooth.mT @ turning()).max() < 0.02
    torch.testing.assert_close(torch.linalg.det(smooth), torch.ones(T).double())


def test_trajectories_side_by_side_are_smoothed_as_each_by_itself() -> None:
    """An outlier of one takes no weight from the others."""
    several = torch.stack([turning() @ axis_angle_to_matrix(noise(0.02, seed)) for seed in range(6)])
    several[2, 20] = several[2, 20] @ axis_angle_to_matrix(torch.tensor([2.5, 0.0, 0.0]).double())
    weights = torch.linspace(0.2, 1.0, T).double()
    together = smooth_rotations(several.reshape(2, 3, T, 3, 3), weights, 2.0).reshape(6, T, 3, 3)
    for one, found in zip(several, together, strict=True):
        torch.testing.assert_close(found, smooth_rotations(one, weights, 2.0), atol=1e-12, rtol=0)


def test_frames_without_weight_are_filled_from_their_neighbours() -> None:
    values, weights = line() + noise(1e-4), torch.ones(T).double()
    values[10:13] = 7.0
    weights[10:13] = 0.0
    assert (smooth_vectors(values, weights, 2.0) - line()).abs().max() < 5e-4
    rotations = turning()
    rotations[10:13] = torch.eye(3).double()
    assert rotation_angle(smooth_rotations(rotations, weights, 2.0).mT @ turning()).max() < 1e-3


def test_interpolated_frames_are_those_inside_a_filled_gap() -> None:
    values = line() + noise(0.01)
    start, end = 12, 19
    share = (torch.arange(start, end + 1) - start)[:, None] / (end - start)
    values[start : end + 1] = values[start] + share * (values[end] - values[start])
    expected = torch.zeros(T, dtype=torch.bool)
    expected[start + 1 : end] = True
    assert torch.equal(interpolated_frames(values), expected)


def test_measured_and_very_short_clips_have_no_interpolated_frames() -> None:
    assert not interpolated_frames(line() + noise(1e-4)).any()
    assert not interpolated_frames(torch.zeros(2, 3)).any()
    assert interpolated_frames(torch.zeros(4, 3)).tolist() == [False, True, True, False]
    bent = line()
    bent[20, 1] += 1e-4  # one coordinate is enough to be a measurement
    assert (~interpolated_frames(bent)).nonzero()[:, 0].tolist() == [0, 19, 20, 21, T - 1]


def test_a_clip_that_is_still_for_most_of_its_length_stays_where_it_is() -> None:
    """Regression: a median residual of zero once left whole windows without weight, and positions at zero."""
    still = torch.tensor([[0.1, 0.2, 0.5]]).repeat(40, 1)
    moving = still[:20] + 0.01 * torch.arange(20.0)[:, None] + 1e-3 * torch.randn(20, 3)
    values = torch.cat([still, moving])
    assert (smooth_vectors(values, torch.ones(60), 1.5) - values).norm(dim=-1).max() < 0.03


def test_a_gap_wider_than_the_window_is_not_sent_to_zero() -> None:
    values = torch.tensor([0.1, 0.2, 0.5]) + 0.002 * torch.arange(60.0)[:, None]
    weights = torch.ones(60)
    weights[10:25] = 0.0
    assert (smooth_vectors(values, weights, 1.0) - values).norm(dim=-1).max() < 0.02

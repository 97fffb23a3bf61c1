"""What is expected of hands between grasps: their depths and orientations."""

from __future__ import annotations

import pytest
import torch
from toy_scenes import cube_scene

from bigs.geometry.rotations import axis_angle_to_matrix, rotation_angle
from bigs.hand import builtin_hand
from bigs.train.grasps.find import carried_errors, expected_depths, turned_between
from bigs.train.loop.pose_terms import depth_prior
from bigs.train.loop.step import Selection, Step


def test_known_errors_are_carried_to_their_neighbours_and_fade_to_the_mean() -> None:
    known = torch.zeros(60, dtype=torch.bool)
    known[:10] = known[50:] = True
    errors = torch.where(torch.arange(60) < 30, 1.0, -1.0)[:, None].repeat(1, 2)
    carried = carried_errors(errors, known, 10.0, noise=0.1)
    assert carried[11].min() > 0.8 and carried[48].max() < -0.8
    torch.testing.assert_close(carried[29] + carried[30], torch.zeros(2), atol=1e-4, rtol=0)
    narrower = carried_errors(errors, known, 3.0, noise=0.1)
    assert narrower[15].max() < 0.5 * carried[15].min(), "fewer frames are alike"
    constant = carried_errors(torch.ones(60, 2), known, 10.0, noise=0.1)
    assert (constant - 1.0).abs().max() < 0.25, "what every known frame shows, all have"


def test_the_depth_between_grasps_is_halfway_between_the_two_guesses() -> None:
    grasped = torch.zeros(30, dtype=torch.bool)
    grasped[:10] = grasped[20:] = True
    true = torch.linspace(-0.5, -0.3, 30)
    wave = 0.1 * torch.sin(torch.arange(30.0))
    # An estimate that is wrong by the same everywhere, and one that wavers: half of its waver is believed.
    for estimated, believed in ((true + 0.2, torch.zeros(30)), (true + 0.2 + wave * ~grasped, 0.5 * wave)):
        expected = expected_depths(true, estimated, grasped, 10.0)
        torch.testing.assert_close(expected[~grasped], (true + believed)[~grasped], atol=0.02, rtol=0)


def test_beyond_the_grasps_the_estimate_is_believed_more() -> None:
    """A hand that comes from far away is not thought to stay where it first held the object."""
    grasped = torch.zeros(30, dtype=torch.bool)
    grasped[12:18] = True
    true = torch.where(grasped, -0.4, -0.2)
    expected = expected_depths(torch.full((30,), -0.4), true + 0.05, grasped, 10.0)
    torch.testing.assert_close(expected[~grasped], torch.full((24,), -0.25), atol=0.03, rtol=0)


def test_free_frames_are_drawn_to_the_depth_they_are_expected_at() -> None:
    scene = cube_scene({"right": builtin_hand()})
    step = Step(scene, None, {}, Selection(torch.arange(3)))
    poses = scene.hand_poses["right"]
    assert depth_prior(step) == 0, "nothing is expected of anything yet"
    with torch.no_grad():
        poses.expected_log_depth[1] = poses.position.base_log_depth[1] + 0.1
        poses.has_expected_depth[1] = True
    loss = depth_prior(Step(scene, None, {}, Selection(torch.arange(3))))
    torch.testing.assert_close(loss, torch.tensor(0.01 / 3 / len(scene.sides)))
    loss.backward()
    gradient = poses.position.log_depth.grad
    assert gradient[1] < 0 and gradient.isfinite().all() and not gradient[[0, 2]].any()


GRASPED = [range(0, 6), range(15, 20)]


def turning(angle: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Orientations [20, 3, 3] of a hand that turns evenly by `angle` between grasps, and of the object."""
    carrier = axis_angle_to_matrix(torch.linspace(0, 1, 20)[:, None] * torch.tensor([0.3, 1.0, 0.2]))
    u = ((torch.arange(20.0) - 5.0) / 10.0).clamp(0.0, 1.0)
    share = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    return carrier @ axis_angle_to_matrix(share[:, None] * torch.tensor([0.0, 0.0, angle])), carrier


@pytest.mark.parametrize("angle", [0.3, 1.2, 3.0, 3.6])
def test_between_grasps_an_even_turn_and_what_was_found_count(angle: float) -> None:
    """Also where it turns by more than half a circle, which seen from its ends is a turn the other way."""
    true, carrier = turning(angle)
    torch.testing.assert_close(turned_between(true, carrier, GRASPED, 16), true, atol=1e-3, rtol=0)
    found = true.clone()
    found[6:15] = true[6:15] @ axis_angle_to_matrix(torch.tensor([0.2, 0.0, 0.0]))
    orient = turned_between(found, carrier, GRASPED, 16)
    errors = rotation_angle(true.transpose(-1, -2) @ orient)[5:16]
    assert (errors[1:-1] > 0.01).all() and (errors < 0.2).all()
    # An even turn is sure next to grasps, and the surer the shorter it is.
    assert errors[[1, -2]].max() < 0.7 * errors[5]
    assert (errors[5] < 0.05) == (angle < 1.0)
    torch.testing.assert_close(turned_between(found, carrier, GRASPED, 8), found)


def test_what_wavers_from_frame_to_frame_is_taken_out() -> None:
    true, carrier = turning(3.0)
    wavering = 0.2 * (-1.0) ** torch.arange(9)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    found = true.clone()
    found[6:15] = true[6:15] @ axis_angle_to_matrix(wavering)
    errors = rotation_angle(true.transpose(-1, -2) @ turned_between(found, carrier, GRASPED, 16))
    assert errors[7:14].max() < 0.02

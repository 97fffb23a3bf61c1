from pathlib import Path

import numpy as np
import pytest
import torch

from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.hand import (
    JOINT_NAMES,
    HandModel,
    load_hand_models,
    mirror_axis_angle,
    mirror_points,
    mirror_rotation,
    shared_betas,
)
from bigs.types import SIDES


def random_pose(generator: torch.Generator, frames: int = 3) -> dict[str, torch.Tensor]:
    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return {
        "betas": random(10),
        "hand_pose_aa": 0.4 * random(frames, 15, 3),
        "orient_aa": random(frames, 3),
        "wrist": random(frames, 3),
    }


def posed(hand: HandModel, pose: dict[str, torch.Tensor]):
    return hand(
        pose["betas"],
        hand.pose_matrices(pose["hand_pose_aa"]),
        axis_angle_to_matrix(pose["orient_aa"]),
        pose["wrist"],
    )


def test_rest_pose_is_the_template(rich_right: HandModel) -> None:
    hand = rich_right
    identity = torch.eye(3, dtype=torch.float64)
    betas = torch.zeros(10, dtype=torch.float64)
    wrist = hand.rest_joints(betas)[:1]
    out = hand(betas, identity.expand(1, 15, 3, 3), identity[None], wrist)
    torch.testing.assert_close(out.vertices[0], hand.v_template)
    torch.testing.assert_close(out.joints[0, :16], hand.rest_joints(betas))
    torch.testing.assert_close(out.bone_transforms[0], torch.eye(4, dtype=torch.float64).expand(16, 4, 4))


def test_the_wrist_lands_where_asked(rich_right: HandModel, generator: torch.Generator) -> None:
    pose = random_pose(generator)
    torch.testing.assert_close(posed(rich_right, pose).joints[:, 0], pose["wrist"])


def test_the_wrist_rotation_turns_the_posed_hand_about_the_wrist(
    rich_right: HandModel, generator: torch.Generator
) -> None:
    pose = random_pose(generator)
    still = posed(rich_right, pose | {"orient_aa": torch.zeros(3, 3, dtype=torch.float64)})
    turn = axis_angle_to_matrix(pose["orient_aa"])
    expected = (still.vertices - pose["wrist"][:, None]) @ turn.transpose(1, 2) + pose["wrist"][:, None]
    torch.testing.assert_close(posed(rich_right, pose).vertices, expected)


def test_fingertips_are_vertices_in_the_named_order(right: HandModel, generator: torch.Generator) -> None:
    out = posed(right, random_pose(generator))
    torch.testing.assert_close(out.joints[:, 16:], out.vertices[:, right.tip_vertex_ids])
    assert JOINT_NAMES[16:] == ("thumb_tip", "index_tip", "middle_tip", "ring_tip", "pinky_tip")
    tips, last = right.v_template[right.tip_vertex_ids], right.rest_joints(torch.zeros(10).double())
    nearest = torch.cdist(tips, last).argmin(dim=1)
    assert [JOINT_NAMES[i] for i in nearest] == ["thumb3", "index3", "middle3", "ring3", "pinky3"]


def test_one_shape_per_frame(rich_right: HandModel, generator: torch.Generator) -> None:
    pose = random_pose(generator)
    shapes = torch.randn(3, 10, generator=generator, dtype=torch.float64)
    together = posed(rich_right, pose | {"betas": shapes})
    for t in range(3):
        alone = posed(rich_right, {k: v[t : t + 1] for k, v in pose.items()} | {"betas": shapes[t]})
        torch.testing.assert_close(together.vertices[t], alone.vertices[0])


def test_pose_round_trip_keeps_the_mean_pose_apart(rich_right: HandModel, generator: torch.Generator) -> None:
    pose = random_pose(generator)["hand_pose_aa"]
    rotations = rich_right.pose_matrices(pose)
    torch.testing.assert_close(rotations, axis_angle_to_matrix(pose + rich_right.hands_mean))
    torch.testing.assert_close(rich_right.pose_axis_angle(rotations), pose)


def test_mirroring_twice_is_the_identity(rich_right: HandModel) -> None:
    twice = rich_right.mirrored().mirrored()
    assert (rich_right.mirrored().side, twice.side) == ("left", "right")
    for (name, one), (_, two) in zip(rich_right.named_buffers(), twice.named_buffers(), strict=True):
        assert torch.equal(one.sort(-1)[0], two.sort(-1)[0]) if name == "faces" else torch.equal(one, two)


def test_the_left_hand_in_the_mirrored_pose_is_the_mirror_image(
    rich_right: HandModel, generator: torch.Generator
) -> None:
    pose = random_pose(generator)
    mirrored = {
        "betas": pose["betas"],
        "hand_pose_aa": mirror_axis_angle(pose["hand_pose_aa"]),
        "orient_aa": mirror_axis_angle(pose["orient_aa"]),
        "wrist": mirror_points(pose["wrist"]),
    }
    left, right = posed(rich_right.mirrored(), mirrored), posed(rich_right, pose)
    torch.testing.assert_close(left.vertices, mirror_points(right.vertices))
    torch.testing.assert_close(left.joints, mirror_points(right.joints))


def test_mirrored_rotation_vectors_and_matrices_agree(generator: torch.Generator) -> None:
    axis_angle = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(
        mirror_rotation(axis_angle_to_matrix(axis_angle)),
        axis_angle_to_matrix(mirror_axis_angle(axis_angle)),
    )


def signed_volume(hand: HandModel) -> float:
    a, b, c = hand.v_template[hand.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


def test_mirroring_keeps_the_winding_outward(right: HandModel) -> None:
    assert signed_volume(right) > 0
    assert signed_volume(right.mirrored()) == pytest.approx(signed_volume(right))


def test_shared_betas_of_a_mirrored_file_are_the_left_ones(
    rich_right: HandModel, generator: torch.Generator
) -> None:
    betas = torch.randn(10, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(shared_betas(rich_right, rich_right.mirrored(), betas), betas)


def test_shared_betas_are_nearest_when_the_left_file_has_the_wrong_x_sign(
    rich_right: HandModel, generator: torch.Generator
) -> None:
    left = rich_right.mirrored()
    left.shapedirs[:, 0] *= -1
    betas = torch.randn(10, generator=generator, dtype=torch.float64)
    found = shared_betas(rich_right, left, betas)
    assert (found - betas).abs().max() > 0.1

    def distance(candidate: torch.Tensor) -> float:
        shapes = mirror_points(rich_right.rest_vertices(candidate)), left.rest_vertices(betas)
        wrists = mirror_points(rich_right.rest_joints(candidate)[0]), left.rest_joints(betas)[0]
        return float(((shapes[0] - wrists[0]) - (shapes[1] - wrists[1])).square().sum())

    assert distance(found) < distance(betas)
    for step in torch.randn(20, 10, generator=generator, dtype=torch.float64):
        assert distance(found) < distance(found + 0.01 * step)


def test_a_checkpoint_holds_no_model_data(right: HandModel) -> None:
    assert right.state_dict() == {}


@pytest.mark.parametrize("side", SIDES)
def test_reproduces_vertices_and_joints_of_a_clip(hand_model_dir: Path, clips_dir: Path, side: str) -> None:
    """The datasets' convention: lbs(pose, betas) + trans, the wrist rotation about the rest wrist."""
    truth = np.load(clips_dir / "dev_mustard" / "gt.npz")
    pose, betas, trans = (torch.from_numpy(truth[f"{side}_{key}"]) for key in ("pose", "betas", "trans"))
    hand = load_hand_models(hand_model_dir)[side].double()
    out = hand(
        betas,
        hand.pose_matrices(pose[:, 3:].reshape(-1, 15, 3)),
        axis_angle_to_matrix(pose[:, :3]),
        hand.rest_joints(betas)[0] + trans,
    )
    assert np.abs(out.vertices.numpy() - truth[f"{side}_verts"]).max() < 1e-5
    assert np.abs(out.joints.numpy() - truth[f"{side}_joints"]).max() < 1e-5

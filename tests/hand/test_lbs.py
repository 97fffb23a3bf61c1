import pytest
import torch

from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.hand.lbs import (
    blend_transforms,
    forward_kinematics,
    pose_corrective,
    shape_vertices,
    skin_points,
)
from bigs.hand.model import MANO_PARENTS


def small_hand(points: int = 6) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return {
        "rest": 0.1 * random(16, 3),
        "points": 0.1 * random(points, 3),
        "weights": torch.softmax(random(points, 16), dim=-1),
        "pose": random(2, 16, 3),
        "root": random(2, 3),
        "posedirs": 0.01 * random(points, 3, 135),
        "shapedirs": 0.01 * random(points, 3, 10),
        "betas": random(10),
    }


def chain_of_transforms(pose: torch.Tensor, rest: torch.Tensor, root: torch.Tensor) -> torch.Tensor:
    """The obvious way: walk from each joint to the root, one frame at a time."""
    rotations = axis_angle_to_matrix(pose)
    out = torch.zeros(len(pose), 16, 4, 4, dtype=torch.float64)
    for t in range(len(pose)):
        for joint in range(16):
            total, k = torch.eye(4, dtype=torch.float64), joint
            while k != -1:
                parent = MANO_PARENTS[k]
                local = torch.eye(4, dtype=torch.float64)
                local[:3, :3] = rotations[t, k]
                local[:3, 3] = rest[k] - rest[parent] if parent >= 0 else root[t]
                total, k = local @ total, parent
            total[:3, 3] -= total[:3, :3] @ rest[joint]
            out[t, joint] = total
    return out


def test_forward_kinematics_is_the_product_of_joint_transforms() -> None:
    hand = small_hand()
    joints, bones = forward_kinematics(
        axis_angle_to_matrix(hand["pose"]), hand["rest"], MANO_PARENTS, hand["root"]
    )
    expected = chain_of_transforms(hand["pose"], hand["rest"], hand["root"])
    torch.testing.assert_close(bones, expected)
    posed = (expected[..., :3, :3] @ hand["rest"][..., None])[..., 0] + expected[..., :3, 3]
    torch.testing.assert_close(joints, posed)


def test_a_tree_in_another_order_poses_the_same() -> None:
    hand = small_hand()
    parents = (-1, 0, 0, 1, 2, 4)
    order = [0, 2, 1, 4, 3, 5]  # the same tree with its branches swapped
    swapped = (-1, 0, 0, 1, 2, 3)
    rotations, rest = axis_angle_to_matrix(hand["pose"][:, :6]), hand["rest"][:6]
    _, bones = forward_kinematics(rotations, rest, parents, hand["root"])
    _, other = forward_kinematics(rotations[:, order], rest[order], swapped, hand["root"])
    torch.testing.assert_close(bones[:, order], other)


def test_skinning_is_the_weighted_sum_over_bones() -> None:
    hand = small_hand()
    bones = chain_of_transforms(hand["pose"], hand["rest"], hand["root"])
    expected = torch.zeros(2, 6, 3, dtype=torch.float64)
    for k in range(16):
        moved = hand["points"] @ bones[:, k, :3, :3].transpose(1, 2) + bones[:, k, None, :3, 3]
        expected += hand["weights"][:, k, None] * moved
    torch.testing.assert_close(skin_points(hand["points"], hand["weights"], bones), expected)
    per_frame = hand["points"].expand(2, -1, -1)
    torch.testing.assert_close(skin_points(per_frame, hand["weights"], bones), expected)
    blended = blend_transforms(hand["weights"], bones)
    moved = (blended[..., :3, :3] @ hand["points"][..., None])[..., 0] + blended[..., :3, 3]
    torch.testing.assert_close(moved, expected)
    assert torch.equal(blended[..., 3, :], torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(2, 6, 4))


def test_pose_corrective_is_row_major_per_joint() -> None:
    posedirs = torch.zeros(4, 3, 135, dtype=torch.float64)
    posedirs[2, 1, 9 * 4 + 3 * 0 + 2] = 1.0  # joint 5 (the fifth without the root), row 0, column 2
    rotations = axis_angle_to_matrix(small_hand()["pose"][:, 1:])
    offsets = pose_corrective(posedirs, rotations)
    torch.testing.assert_close(offsets[:, 2, 1], rotations[:, 4, 0, 2])
    assert offsets.abs().sum() == offsets[:, 2, 1].abs().sum()


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, torch.pi - 1e-4, torch.pi])
def test_gradients_of_a_posed_hand(angle: float) -> None:
    hand = small_hand(points=3)
    axes = torch.nn.functional.normalize(hand["pose"], dim=-1)

    def pose_points(pose: torch.Tensor, betas: torch.Tensor, root: torch.Tensor, weights: torch.Tensor):
        rotations = axis_angle_to_matrix(pose)
        shaped = shape_vertices(hand["points"], hand["shapedirs"][:3], betas)
        corrected = shaped + pose_corrective(hand["posedirs"], rotations[:, 1:])
        _, bones = forward_kinematics(rotations, hand["rest"], MANO_PARENTS, root)
        return skin_points(corrected, weights, bones), blend_transforms(weights, bones)

    inputs = (angle * axes, hand["betas"], hand["root"], hand["weights"])
    assert torch.autograd.gradcheck(pose_points, tuple(x.clone().requires_grad_() for x in inputs))


def test_gradients_of_skinning_shared_points() -> None:
    hand = small_hand(points=3)
    bones = chain_of_transforms(hand["pose"], hand["rest"], hand["root"])
    inputs = (hand["points"], hand["weights"], bones)
    assert torch.autograd.gradcheck(skin_points, tuple(x.clone().requires_grad_() for x in inputs))

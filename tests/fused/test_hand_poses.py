"""A hand's poses from residuals and grasps: compiled against the same in torch."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bigs.fused.hand_poses import Carried, Learned, hand_poses
from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.hand import mirror_rotation

CLIP, JOINTS, GRASPS = 5, 3, 5
# In an order of their own, and one of them twice.
FRAMES = torch.tensor([4, 0, 2, 3, 0])


def random(*shape: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def learned(bend: float = 0.3) -> Learned:
    return Learned(
        axis_angle_to_matrix(random(CLIP, 3, seed=1)),
        axis_angle_to_matrix(random(CLIP, JOINTS, 3, seed=2)),
        0.2 * random(CLIP, 2, seed=3),
        0.1 * random(CLIP, seed=4),
        *(
            (bend * random(*shape, seed=5 + i)).requires_grad_()
            for i, shape in enumerate(((CLIP, 3), (CLIP, JOINTS, 3), (JOINTS, 3), (CLIP, 2), (CLIP,)))
        ),
    )


def carried(mirrored: bool, frames: Tensor = FRAMES) -> Carried:
    """Two grasps and a frame without."""
    return Carried(
        axis_angle_to_matrix(random(GRASPS, 3, seed=11)),
        axis_angle_to_matrix(random(GRASPS, JOINTS, 3, seed=12)),
        0.1 * random(GRASPS, 3, seed=13),
        (0.3 * random(GRASPS, 3, seed=14)).requires_grad_(),
        (0.3 * random(GRASPS, JOINTS, 3, seed=15)).requires_grad_(),
        (0.1 * random(GRASPS, 3, seed=16)).requires_grad_(),
        axis_angle_to_matrix(random(CLIP, 3, seed=17))[frames].requires_grad_(),
        (torch.tensor([0.1, 0.2, 1.0]) + 0.1 * random(CLIP, 3, seed=18))[frames].requires_grad_(),
        torch.tensor(1.1, dtype=torch.float64).requires_grad_(),
        torch.tensor([0, 0, -1, 1, 1]),
        0.25,
        mirrored,
    )


def twin(frames: Tensor, own: Learned, held: Carried | None) -> tuple[Tensor, Tensor, Tensor]:
    start_orient, start_pose = own.base_orient[frames], own.base_pose[frames]
    ray, log_depth = own.base_ray[frames], own.base_log_depth[frames]
    freedom = torch.ones(len(frames), dtype=torch.float64)
    if held is not None:
        grasped = held.of_frame[frames] >= 0
        g = held.of_frame[frames].clamp_min(0)
        seen = mirror_rotation(held.rotations) if held.mirrored else held.rotations
        orient = seen @ axis_angle_to_matrix(held.orient[g]) @ held.base_orient[g]
        pose = held.base_pose[g] @ axis_angle_to_matrix(held.pose[g])
        place = (held.base_position[g] + held.position[g])[..., None]
        wrist = held.scale * (held.rotations @ place)[..., 0] + held.centers
        start_orient = torch.where(grasped[:, None, None], orient, start_orient)
        start_pose = torch.where(grasped[:, None, None, None], pose, start_pose)
        ray = torch.where(grasped[:, None], wrist[:, :2] / wrist[:, 2:], ray)
        log_depth = torch.where(grasped, wrist[:, 2].log(), log_depth)
        freedom = torch.where(grasped, held.slack, 1.0)
    turn = axis_angle_to_matrix(freedom[:, None] * own.orient[frames])
    bend = axis_angle_to_matrix(freedom[:, None, None] * (own.pose[frames] + own.pose_bias))
    depth = (log_depth + freedom * own.log_depth[frames]).exp()[:, None]
    ray = ray + freedom[:, None] * own.ray[frames]
    return turn @ start_orient, start_pose @ bend, torch.cat([ray * depth, depth], dim=-1)


def inputs(own: Learned, held: Carried | None) -> list[Tensor]:
    return [t for t in (*own, *(held or ())) if isinstance(t, Tensor) and t.requires_grad]


@pytest.mark.parametrize("mirrored", [False, True, None])
def test_poses_are_the_twins(mirrored: bool | None) -> None:
    own, held = learned(), None if mirrored is None else carried(mirrored)
    found, expected = hand_poses(FRAMES, own, held), twin(FRAMES, own, held)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-13, rtol=1e-12)
    for which in ([0], [1], [2], [0, 1, 2]):
        pulls = [random(*found[i].shape, seed=30 + i) for i in which]
        one, other = (
            torch.autograd.grad(
                [poses[i] for i in which], inputs(own, held), pulls, retain_graph=True, allow_unused=True
            )
            for poses in (found, expected)
        )
        for a, b in zip(one, other, strict=True):
            torch.testing.assert_close(a, torch.zeros_like(a) if b is None else b, atol=1e-11, rtol=1e-10)


def test_gradients_are_finite_differences() -> None:
    own, held = learned(), carried(True)

    def posed(*tensors: Tensor) -> tuple[Tensor, ...]:
        return hand_poses(
            FRAMES, Learned(*own[:4], *tensors[:5]), Carried(*held[:3], *tensors[5:], *held[9:])
        )

    assert torch.autograd.gradcheck(posed, inputs(own, held))


def test_single_precision_is_near_double() -> None:
    def single(parts: Learned | Carried):
        return type(parts)(
            *(t.float() if isinstance(t, Tensor) and t.is_floating_point() else t for t in parts)
        )

    own, held = learned(), carried(True)
    for a, b in zip(
        hand_poses(FRAMES, single(own), single(held)), hand_poses(FRAMES, own, held), strict=True
    ):
        assert a.dtype == torch.float32
        torch.testing.assert_close(a.double(), b, atol=1e-6, rtol=1e-5)


def test_only_what_was_asked_for_gets_a_gradient() -> None:
    own, held = learned(), carried(False, torch.tensor([1, 2]))
    sum(part.sum() for part in hand_poses(torch.tensor([1, 2]), own, held)).backward()
    assert (own.orient.grad != 0).any(1).tolist() == [False, True, True, False, False]
    assert (held.orient.grad != 0).any(1).tolist() == [True, False, False, False, False]
    # The object carries the hand in the first of the two frames alone.
    assert (held.centers.grad != 0).any(1).tolist() == [True, False]


def test_what_does_not_fit_is_refused() -> None:
    own, held = learned(), carried(False)
    for wrong in (
        own._replace(base_pose=own.base_pose[:, :2]),
        own._replace(ray=own.ray[:2]),
        own._replace(pose_bias=own.pose_bias[:, :2]),
    ):
        with pytest.raises(ValueError, match="expected"):
            hand_poses(FRAMES, wrong, None)
    for wrong in (
        held._replace(of_frame=held.of_frame[:2]),
        held._replace(of_frame=held.of_frame + 4),
        held._replace(centers=held.centers[:2]),
    ):
        with pytest.raises(ValueError, match="expected"):
            hand_poses(FRAMES, own, wrong)
    with pytest.raises(ValueError, match="frames"):
        hand_poses(torch.tensor([CLIP]), own, None)

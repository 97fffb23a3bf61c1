"""The hands' Gaussians against the template's surface, a slow skinning, and their own mirror image."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.spatial
import torch
from posed_hands import pose_hand
from posing_twin import third_axis
from small_scene import HAND, covariances, disturb, hand_model, rotations

from bigs.fused.posing import Posing, pose
from bigs.geometry.mesh import midpoint_subdivision, point_spacing
from bigs.geometry.rotations import axis_angle_to_matrix, matrix_to_quat, quat_to_matrix
from bigs.hand import mirror_points
from bigs.models.hand_splats import (
    HandSplats,
    neighbour_weights,
)
from bigs.models.poses import HandFrames
from bigs.models.posing import hand_part, pose_parts

BETAS = torch.randn(10, generator=torch.Generator().manual_seed(0))
MIRROR = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))


def splats(rich: bool = True, changed: bool = True, **config) -> HandSplats:
    torch.manual_seed(0)
    made = HandSplats(hand_model(rich), replace(HAND, **config))
    if changed:
        disturb(made, 0.2)
    return made


def frames(count: int = 3) -> HandFrames:
    return HandFrames(
        rotations(count, angle=1.0, seed=1),
        rotations(count, 15, angle=0.4, seed=2),
        torch.tensor([0.1, 0.0, 0.7])
        + 0.1 * torch.rand(count, 3, generator=torch.Generator().manual_seed(3)),
    )


def rest(betas: torch.Tensor, rich: bool = True) -> HandFrames:
    """No rotation, the wrist where the rest pose has it."""
    eye = torch.eye(3)
    return HandFrames(eye[None], eye.expand(1, 15, 3, 3), hand_model(rich).rest_joints(betas)[:1])


@pytest.mark.parametrize("subdivisions", [0, 1])
@torch.no_grad()
def test_at_rest_a_fresh_hand_lies_on_the_template_less_the_inset(subdivisions: int) -> None:
    model = hand_model(rich=True)
    color = (0.6, 0.5, 0.4)
    made = splats(changed=False, subdivisions=subdivisions, color=color)
    posed = pose_hand(model, made(), torch.zeros(10), rest(torch.zeros(10)), "right")
    surface, faces = model.v_template.double().numpy(), model.faces.numpy()
    for _ in range(subdivisions):
        step, faces = midpoint_subdivision(faces, len(surface))
        surface = step @ surface
    # Put the centres back out by three standard deviations across the surface.
    outer = posed.means[0] + 3.0 * posed.scales[:, 2:] * third_axis(posed.quats[0])
    np.testing.assert_allclose(outer.numpy(), surface, atol=1e-6)
    spacing = torch.as_tensor(point_spacing(surface), dtype=torch.float32)
    torch.testing.assert_close(posed.scales[:, 0], HAND.scale_per_spacing * spacing)
    torch.testing.assert_close(posed.scales[:, 1], posed.scales[:, 0])
    torch.testing.assert_close(posed.scales[:, 2], HAND.flatness * posed.scales[:, 0])
    torch.testing.assert_close(posed.colors, torch.tensor(color).expand(len(surface), 3))
    torch.testing.assert_close(posed.opacities, torch.full((len(surface),), HAND.opacity))
    # The step went inwards.
    inner_volume = scipy.spatial.ConvexHull(posed.means[0].numpy()).volume
    assert inner_volume < scipy.spatial.ConvexHull(surface).volume


@torch.no_grad()
def test_attributes_follow_the_subdivision() -> None:
    model = hand_model(rich=True)
    fine, coarse = splats(changed=False, subdivisions=1)(), splats(changed=False)()
    step, _ = midpoint_subdivision(model.faces.numpy(), len(model.v_template))
    assert len(fine.points) == step.shape[0]
    for name in ("shapedirs", "posedirs"):
        whole = getattr(model, name)
        assert torch.equal(getattr(coarse, name), whole)
        expected = step @ whole.flatten(1).double().numpy()
        np.testing.assert_allclose(getattr(fine, name).flatten(1).numpy(), expected, atol=1e-7)


@torch.no_grad()
def test_gaussians_go_where_the_meshs_vertices_go() -> None:
    model, pose = hand_model(rich=True), frames()
    hand = splats(changed=False)()
    posed = pose_hand(model, hand, BETAS, pose, "right")
    vertices = model(BETAS, pose.hand_pose, pose.global_orient, pose.wrist).vertices
    gap = (posed.means - vertices).norm(dim=-1)
    # The inset, and a hair for the floor under the skinning weights' logarithm.
    assert (gap - 3.0 * hand.scales[:, 2]).abs().max() < 1e-3
    assert (gap - 3.0 * hand.scales[:, 2]).abs().mean() < 2e-4


@torch.no_grad()
def test_means_are_the_weighted_sum_over_bones() -> None:
    model, pose = hand_model(rich=True), frames()
    hand = splats()()
    bones = model(BETAS, pose.hand_pose, pose.global_orient, pose.wrist).bone_transforms.double()
    features = (pose.hand_pose - torch.eye(3)).reshape(3, 135).double()
    for t in range(3):
        x = hand.points.double() + hand.shapedirs.double() @ BETAS.double()
        x = x + hand.posedirs.double() @ features[t]
        expected = torch.zeros_like(x)
        for k in range(16):
            moved = x @ bones[t, k, :3, :3].T + bones[t, k, :3, 3]
            expected += hand.weights[:, k, None].double() * moved
        posed = pose_hand(model, hand, BETAS, pose, "right").means[t]
        torch.testing.assert_close(posed.double(), expected, atol=1e-6, rtol=0)


@torch.no_grad()
def test_skinning_rows_sum_to_one() -> None:
    for changed in (False, True):
        weights = splats(changed=changed)().weights
        torch.testing.assert_close(weights.sum(-1), torch.ones(len(weights)))
        assert (weights >= 0).all()


@torch.no_grad()
def test_the_left_hand_is_the_right_one_in_a_mirror() -> None:
    model, pose, hand = hand_model(rich=True), frames(), splats()()
    right = pose_hand(model, hand, BETAS, pose, "right")
    left = pose_hand(model, hand, BETAS, pose, "left")
    assert torch.equal(left.means, right.means * torch.tensor([-1.0, 1.0, 1.0]))
    torch.testing.assert_close(covariances(left), MIRROR @ covariances(right) @ MIRROR, atol=1e-10, rtol=1e-4)
    assert torch.equal(left.colors, right.colors) and torch.equal(left.scales, right.scales)
    # The normal that the light sees is mirrored with the surface.
    torch.testing.assert_close(third_axis(left.quats), mirror_points(third_axis(right.quats)))


@pytest.mark.parametrize("angle", [1e-4, 1.0, 3.1])
@torch.no_grad()
def test_turning_the_whole_hand_turns_every_covariance(angle: float) -> None:
    model, hand = hand_model(rich=True), splats()()
    start = rest(BETAS)
    axis = torch.nn.functional.normalize(torch.tensor([0.3, -1.0, 0.5]), dim=0)
    turn = axis_angle_to_matrix(angle * axis)
    wrist = torch.tensor([[0.2, -0.1, 0.9]])
    still = pose_hand(model, hand, BETAS, start, "right")
    turned = pose_hand(model, hand, BETAS, start._replace(global_orient=turn[None], wrist=wrist), "right")
    torch.testing.assert_close(turned.means, (still.means - start.wrist) @ turn.T + wrist, atol=1e-6, rtol=0)
    torch.testing.assert_close(covariances(turned), turn @ covariances(still) @ turn.T, atol=1e-10, rtol=1e-4)


@torch.no_grad()
def test_a_gaussian_of_one_bone_turns_with_that_bone() -> None:
    model, pose = hand_model(rich=True), frames()
    bones = model(BETAS, pose.hand_pose, pose.global_orient, pose.wrist).bone_transforms
    one_bone = splats()()._replace(weights=torch.eye(16)[torch.arange(len(model.v_template)) % 16])
    posed = pose_parts([hand_part(one_bone, one_bone.points, bones, "right")])
    resting = covariances(posed._replace(quats=one_bone.quats))
    turns = bones[:, torch.arange(len(one_bone.points)) % 16, :3, :3]
    torch.testing.assert_close(covariances(posed), turns @ resting @ turns.mT, atol=1e-10, rtol=1e-4)


@torch.no_grad()
def test_bones_whose_quaternions_differ_in_sign_do_not_cancel() -> None:
    bones = torch.eye(4).expand(1, 16, 4, 4).clone()
    # On either side of 90 degrees the conversion takes opposite signs.
    angles = torch.tensor([1.5, 1.7])
    bones[0, :2, :3, :3] = axis_angle_to_matrix(angles[:, None] * torch.tensor([-1.0, 0.0, 0.0]))
    quats = matrix_to_quat(bones[0, :2, :3, :3])
    assert quats[0] @ quats[1] < 0
    weights = torch.zeros(1, 16)
    weights[0, :2] = 0.5
    identity = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    _, turned, _ = pose([Posing(torch.zeros(1, 3), weights, bones, identity, torch.ones(1, 3))], None, False)
    blended = turned[0, 0]
    assert blended.norm() > 0.9
    between = axis_angle_to_matrix(torch.tensor([-1.6, 0.0, 0.0]))
    torch.testing.assert_close(quat_to_matrix(blended), between, atol=1e-6, rtol=0)


@torch.no_grad()
def test_geometry_stays_when_it_is_not_learned() -> None:
    model = hand_model(rich=True)
    frozen, fresh = splats(learn_geometry=False)(), splats(changed=False)()
    free = splats()()
    for name in ("points", "quats", "scales"):
        assert torch.equal(getattr(frozen, name), getattr(fresh, name))
        assert not torch.equal(getattr(free, name), getattr(fresh, name))
    assert not torch.equal(frozen.colors, fresh.colors)
    assert (free.points - fresh.points).abs().max() <= HAND.max_offset
    assert len(free.points) == len(model.v_template)


def test_a_model_without_correctives_poses_like_one_with_zeros() -> None:
    made = splats(rich=False)
    hand = made()
    assert hand.posedirs is None
    zeros = hand._replace(posedirs=torch.zeros(len(hand.points), 3, 135))
    with_zeros = pose_hand(made.model, zeros, BETAS, frames(), "right")
    torch.testing.assert_close(pose_hand(made.model, hand, BETAS, frames(), "right").means, with_zeros.means)


def test_neighbour_weights_are_a_vertexs_own_on_it_and_a_mean_between() -> None:
    model = hand_model()
    verts = model.v_template
    on = neighbour_weights(verts.double().numpy(), verts, model.lbs_weights)
    torch.testing.assert_close(on, model.lbs_weights, atol=1e-5, rtol=0)
    line = torch.tensor([[0.0, 0, 0], [1, 0, 0], [5, 0, 0], [6, 0, 0], [7, 0, 0], [8, 0, 0]])
    weights = torch.eye(16)[:6]
    between = neighbour_weights(np.array([[0.5, 0.0, 0.0]]), line, weights)[0]
    inverse = torch.tensor([4.0, 4.0, 1 / 4.5**2, 1 / 5.5**2, 1 / 6.5**2, 1 / 7.5**2])
    torch.testing.assert_close(between[:6], inverse / inverse.sum())
    assert between.sum() == pytest.approx(1.0)


def test_every_part_of_the_hand_learns() -> None:
    made = splats()
    posed = pose_hand(made.model, made(), BETAS, frames(), "left")
    generator = torch.Generator().manual_seed(5)
    loss = sum((value * torch.randn(value.shape, generator=generator)).sum() for value in posed)
    loss.backward()
    assert all(p.grad is not None and p.grad.isfinite().all() and p.grad.any() for p in made.parameters())

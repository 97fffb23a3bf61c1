"""Hand poses of given joints or meshes: geometry that an estimator predicts becomes parameters."""

from __future__ import annotations

import torch
from torch import Tensor

from bigs.geometry.rotations import axis_angle_to_matrix, project_to_rotation
from bigs.hand import HandModel
from bigs.preprocess.hands.descent import minimise
from bigs.preprocess.hands.skeleton import HandPoses, HandSkeleton

# Wrist and knuckles move together, so they give the hand's orientation.
_PALM = (0, 1, 4, 7, 10)
_STEPS = 250
_RATE = 0.03
# A millimetre counts as one standard deviation, so that the pose prior decides only what geometry leaves
# open.
_MILLIMETRE = 1e-3


def fit_geometry(
    right: HandModel, joints: Tensor, vertices: Tensor | None
) -> tuple[HandPoses, Tensor, Tensor]:
    """Least squares of one hand's pose in every frame and one shape.

    Args:
        right: the right-hand model.
        joints: [T, 21, 3] of a right hand (a left one mirrored), camera frame, metres.
        vertices: [T, V, 3] likewise, used if the model has as many.

    Returns:
        Poses [T, ...], betas [10], and the mean distance [T] that is left, metres.
    """
    skeleton = HandSkeleton(right)
    if vertices is not None and vertices.shape[1] != len(right.v_template):
        vertices = None
    rest = skeleton.joints(torch.zeros(10), skeleton.mean[None], torch.eye(3)[None], torch.zeros(1, 3))[0]
    palm = list(_PALM)
    source, target = rest[palm] - rest[palm].mean(0), joints[:, palm] - joints[:, palm].mean(1, keepdim=True)
    # Kabsch: the rotation that maps the rest palm closest to the given one.
    orient = project_to_rotation(torch.einsum("tni,nj->tij", target, source))
    turn = torch.zeros(len(joints), 3, requires_grad=True)
    angles = skeleton.mean.repeat(len(joints), 1, 1).requires_grad_()
    wrist = joints[:, 0].clone().requires_grad_()
    betas = torch.zeros(10, requires_grad=True)

    def distances() -> Tensor:
        rotation = orient @ axis_angle_to_matrix(turn)
        found = skeleton.joints(betas, angles, rotation, wrist)
        apart = (found - joints).square().sum(-1).mean(-1)
        if vertices is None:
            return apart
        matrices = axis_angle_to_matrix(skeleton.fingers(angles))
        mesh = right(betas, matrices, rotation, wrist).vertices
        return apart + (mesh - vertices).square().sum(-1).mean(-1)

    def total() -> Tensor:
        usual = 0.05 * skeleton.unlikeliness(angles).sum() + betas.square().sum()
        return 21.0 * distances().sum() / _MILLIMETRE**2 + usual

    groups = [{"params": [turn, angles, betas], "lr": _RATE}, {"params": [wrist], "lr": 0.1 * _RATE}]
    minimise(total, groups, _STEPS)
    with torch.no_grad():
        poses = HandPoses(angles.detach(), orient @ axis_angle_to_matrix(turn), wrist.detach())
        return poses, betas.detach(), distances().sqrt()

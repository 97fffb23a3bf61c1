"""Linear blend skinning on a joint tree as pure, differentiable functions (paper Eq. 3).

T is frames, V vertices, N points, K joints (16), S shape directions (10). Metres. Rotations are 3x3 matrices
that act on column vectors, each relative to its parent's frame. Nothing here knows of sides or files.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bigs.fused.joints import pose_tree
from bigs.fused.posing import Posing, skin


def shape_vertices(template: Tensor, shapedirs: Tensor, betas: Tensor) -> Tensor:
    """Rest vertices [..., V, 3]: `template` [V, 3] plus `shapedirs` [V, 3, S] times `betas` [..., S]."""
    offsets = betas @ shapedirs.reshape(-1, shapedirs.shape[-1]).T
    return template + offsets.reshape(*betas.shape[:-1], *template.shape)


def pose_corrective(posedirs: Tensor, hand_pose: Tensor) -> Tensor:
    """Vertex offsets posedirs . vec(R - I) that a pose adds before skinning.

    Args:
        posedirs: [V, 3, 9 (K-1)] metres; the last axis is joint-major, each rotation row-major.
        hand_pose: [T, K-1, 3, 3] rotations of every joint but the root.

    Returns:
        [T, V, 3] metres, in the rest pose's frame.
    """
    identity = torch.eye(3, dtype=hand_pose.dtype, device=hand_pose.device)
    features = (hand_pose - identity).flatten(-3)
    offsets = features @ posedirs.reshape(-1, posedirs.shape[-1]).T
    return offsets.reshape(*features.shape[:-1], *posedirs.shape[:2])


def forward_kinematics(
    rotations: Tensor, rest_joints: Tensor, parents: tuple[int, ...], root: Tensor
) -> tuple[Tensor, Tensor]:
    """Pose a joint tree.

    Args:
        rotations: [T, K, 3, 3], joint 0 first; joint 0 turns about itself, not about the origin.
        rest_joints: [K, 3] or [T, K, 3] metres.
        parents: K indices, each smaller than its own position; the root's entry is not used.
        root: [T, 3] where joint 0 comes to lie, metres.

    Returns:
        posed joints [T, K, 3] and bone transforms [T, K, 4, 4] that carry rest points to posed points.
    """
    return pose_tree(rotations, rest_joints, parents, root)


def blend_transforms(weights: Tensor, bone_transforms: Tensor) -> Tensor:
    """The transform of every point, sum_k W_k G_k, for weights that sum to 1.

    Args:
        weights: [N, K].
        bone_transforms: [T, K, 4, 4].

    Returns:
        [T, N, 4, 4]; the upper left 3x3 part is a blend of rotations, in general not itself a rotation.
    """
    frames, joints = bone_transforms.shape[:2]
    upper = weights @ bone_transforms[:, :, :3].reshape(frames, joints, 12)
    return _with_last_row(upper.reshape(frames, -1, 3, 4))


def skin_points(points: Tensor, weights: Tensor, bone_transforms: Tensor) -> Tensor:
    """Carry rest points to every frame, sum_k W_k (Phi_k x + Gamma_k) (paper Eq. 3).

    Args:
        points: [N, 3] shared by all frames, or [T, N, 3] when a pose corrective was added; metres, rest pose.
        weights: [N, K], rows sum to 1.
        bone_transforms: [T, K, 4, 4].

    Returns:
        [T, N, 3] metres.
    """
    return skin(Posing(points, weights, bone_transforms))


def _with_last_row(upper: Tensor) -> Tensor:
    """Affine [..., 3, 4] completed to [..., 4, 4]."""
    last = upper.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*upper.shape[:-2], 1, 4)
    return torch.cat([upper, last], dim=-2)

"""All conversions of rotations. Matrices act on column vectors; quaternions are w x y z.

The two conversions that every step of an optimisation makes many times are written as few operations on small
tensors, since each costs as much as its arithmetic; the others are kornia's. Gradients are finite at the
identity and at pi.
"""

from __future__ import annotations

import torch
from kornia.geometry.conversions import (
    quaternion_to_rotation_matrix,
    rotation_matrix_to_axis_angle,
)
from torch import Tensor

from bigs.fused.joints import rotations

# 1 + vec(R) @ _OUTER on the diagonal, and the same without 1 off it, is 4 q q^T for the quaternion q of R.
_OUTER = torch.tensor(
    [
        [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1],
        [0, 0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, -1, 0, 0, 0],
        [0, 0, 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0, 1, 0, 0],
        [0, 0, 0, 1, 0, 0, 1, 0, 0, 1, 0, 0, 1, 0, 0, 0],
        [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1],
        [0, -1, 0, 0, -1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 1, 0],
        [0, 0, -1, 0, 0, 0, 0, 1, -1, 0, 0, 0, 0, 1, 0, 0],
        [0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 1, 0],
        [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1],
    ],
    dtype=torch.float32,
)


def axis_angle_to_matrix(axis_angle: Tensor) -> Tensor:
    """Rotation vectors [..., 3] (radians) to matrices [..., 3, 3], by Rodrigues' formula."""
    return rotations(axis_angle)


def matrix_to_axis_angle(matrices: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] to rotation vectors [..., 3] of length at most pi."""
    return rotation_matrix_to_axis_angle(matrices.reshape(-1, 3, 3)).reshape(*matrices.shape[:-2], 3)


def quat_to_matrix(quats: Tensor) -> Tensor:
    """Quaternions [..., 4] (w x y z, any non-zero length) to matrices [..., 3, 3]."""
    return quaternion_to_rotation_matrix(quats.reshape(-1, 4)).reshape(*quats.shape[:-1], 3, 3)


def matrix_to_quat(matrices: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] to unit quaternions [..., 4] (w x y z), of which the largest part is > 0.

    Every row of q q^T is q times one of its parts; the row of the largest part is the one to take.
    """
    flat = matrices.reshape(-1, 9)
    identity = torch.eye(4, dtype=flat.dtype, device=flat.device)
    outer = (flat @ _OUTER.to(flat)).unflatten(-1, (4, 4)) + identity
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    rows = outer[torch.arange(len(flat), device=flat.device), largest]
    return torch.nn.functional.normalize(rows, dim=-1).reshape(*matrices.shape[:-2], 4)


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product of [..., 4] quaternions (w x y z): the rotation `b` first, then `a`."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def rot6d_to_matrix(rot6d: Tensor) -> Tensor:
    """The continuous 6-D form [..., 6] (two columns, Gram-Schmidt) to matrices [..., 3, 3].

    Its identity is (1, 0, 0, 0, 1, 0).
    """
    first, second = rot6d[..., :3], rot6d[..., 3:]
    x = torch.nn.functional.normalize(first, dim=-1)
    y = torch.nn.functional.normalize(second - (x * second).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)


def rotation_angle(matrices: Tensor) -> Tensor:
    """The angle [...] in radians of rotation matrices [..., 3, 3]; no gradient is needed from it."""
    return torch.linalg.vector_norm(matrix_to_axis_angle(matrices), dim=-1)


def mean_rotation(matrices: Tensor, weights: Tensor) -> Tensor:
    """The chordal mean of rotations: the rotation nearest to the weighted sum of matrices.

    Args:
        matrices: [..., N, 3, 3].
        weights: [..., N], non-negative.

    Returns:
        [..., 3, 3], proper rotations.
    """
    return project_to_rotation((weights[..., None, None] * matrices).sum(-3))


def robust_mean_rotation(matrices: Tensor) -> Tensor:
    """A mean of rotations [..., N, 3, 3] that a minority of outliers hardly moves: [..., 3, 3].

    Frobenius distances to the mean re-weight it, as in Weiszfeld's iteration for the geometric median.
    """
    weights = torch.ones(matrices.shape[:-2])
    for _ in range(8):
        mean = mean_rotation(matrices, weights)
        distance = (matrices - mean[..., None, :, :]).square().sum((-1, -2)).sqrt()
        weights = 1.0 / distance.clamp_min(1e-2)
    return mean


def project_to_rotation(matrices: Tensor) -> Tensor:
    """The proper rotations [..., 3, 3] nearest to `matrices` [..., 3, 3] in the Frobenius norm."""
    u, _, vh = torch.linalg.svd(matrices)
    sign = torch.linalg.det(u @ vh)
    u = torch.cat([u[..., :2], u[..., 2:] * sign[..., None, None]], dim=-1)
    return u @ vh

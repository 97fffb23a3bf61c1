"""Posing as torch formulas, as papers write them: what tests compare the compiled form with."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from bigs.fused.posing import Posing
from bigs.geometry.rotations import matrix_to_quat, quat_multiply


def pose_twin(subjects: Sequence[Posing], clip: Tensor | None, labels: bool) -> tuple[Tensor, Tensor, Tensor]:
    """What `bigs.fused.posing.pose` gives."""
    parts = [posed(subject, clip) for subject in subjects]
    if labels:
        rows = torch.eye(len(parts), dtype=parts[0][0].dtype)
        parts = [
            (means, quats, torch.cat([colors, row.expand(*colors.shape[:2], -1)], -1))
            for (means, quats, colors), row in zip(parts, rows, strict=True)
        ]
    means, quats, colors = (torch.cat(values, dim=1) for values in zip(*parts, strict=True))
    return means, quats, colors


def blended(subject: Posing) -> Tensor:
    """The centres [B, N, 3] alone."""
    carried = torch.einsum("nk,bkij->bnij", subject.weights, subject.bones[:, :, :3])
    means = (carried[..., :3] @ subject.points[..., None])[..., 0] + carried[..., 3]
    return means * means.new_tensor([-1.0, 1.0, 1.0]) if subject.mirrored else means


def posed(subject: Posing, clip: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    means = blended(subject)
    bones = matrix_to_quat(subject.bones[:, :, :3, :3])
    bones = torch.where((bones * bones[:, :1]).sum(-1, keepdim=True) < 0, -bones, bones)
    quats = quat_multiply(torch.einsum("nk,bkq->bnq", subject.weights, bones), subject.quats)
    if subject.mirrored:
        # S R S for S = diag(-1, 1, 1).
        quats = quats * quats.new_tensor([1.0, 1.0, -1.0, -1.0])
    colors = subject.albedo.expand(*means.shape[:2], 3)
    if subject.shade is not None:
        normals = third_axis(quats)
        shaded = subject.shade[:, None, :1] + normals @ subject.shade[:, 1:4, None]
        shaded = shaded + subject.parts @ subject.shade[:, 4:, None]
        if subject.occlusion is not None:
            shaded = shaded + subject.occlusion[..., None] * subject.ambient
        colors = colors * torch.exp(quadratic_basis(normals) @ clip + shaded)
    return means, quats, colors


def third_axis(quats: Tensor) -> Tensor:
    """The direction [..., 3] to which quaternions [..., 4] (w x y z, any length) turn the z axis."""
    w, x, y, z = quats.unbind(-1)
    axis = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z], dim=-1)
    return axis / quats.square().sum(-1, keepdim=True).clamp_min(1e-12)


def quadratic_basis(normals: Tensor) -> Tensor:
    """The linear and quadratic harmonics [..., 8] of unit vectors [..., 3]."""
    x, y, z = normals.unbind(-1)
    return torch.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], dim=-1)

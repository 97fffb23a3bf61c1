"""Gaussians of hands and object carried to the frames of a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

import bigs._raster as _raster
from bigs.fused.arrays import array_or_none, shaped


class Posing(NamedTuple):
    """One subject's N Gaussians and what carries them to B frames; an object has one bone."""

    points: Tensor  # [N, 3] metres, rest pose, or [B, N, 3] where a pose corrective was added
    weights: Tensor  # [N, K]
    bones: Tensor  # [B, K, 3, 4] or [B, K, 4, 4]
    quats: Tensor | None = None  # [N, 4] of any length
    albedo: Tensor | None = None  # [N, 3]
    parts: Tensor | None = None  # [N, J] how far each belongs to the parts of a subject; no gradient
    shade: Tensor | None = None  # [B, 4 + J]; without light there are neither parts nor shade
    # [B, N] share of the sky that surfaces nearby cover (see `bigs.fused.occlusion`); no gradient
    occlusion: Tensor | None = None
    ambient: Tensor | None = None  # [3] logarithm of a colour's factor under a sky that is covered altogether
    mirrored: bool = False


# The tensors of a `Posing`; what is left is not one.
_TENSORS = len(Posing._fields) - 1


def pose(subjects: Sequence[Posing], clip: Tensor | None, labels: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Carry subjects to their frames by linear blend skinning, one subject after the other.

    Centres follow the blended transforms, orientations the blended quaternions of the bones' rotations, signs
    aligned with the first bone's; a mirrored subject shows what the plane x = 0 mirrors. Colours are albedos
    times exp of a quadratic function of the outward normal, the Gaussian's third axis, for the clip, and of a
    linear one with a constant for each part for every frame, and times exp of occlusion times ambient (see
    `bigs.models.lighting`).

    Args:
        subjects: of the same B frames and dtype; all with quats and albedo.
        clip: [8, 3], the light of the clip; None if no subject has shade.
        labels: whether colours go on with a channel for each subject, 1 for its own Gaussians.

    Returns:
        Means [B, N, 3], quats [B, N, 4] and colours [B, N, D] of all N Gaussians.
    """
    tensors = [tensor for subject in subjects for tensor in subject[:_TENSORS]]
    mirrored = tuple(subject.mirrored for subject in subjects)
    return _Pose.apply(mirrored, labels, clip, *tensors)


def skin(subject: Posing) -> Tensor:
    """The centres [B, N, 3] alone of a subject; only points, weights and bones count."""
    bare = Posing(*subject[:3], mirrored=subject.mirrored)
    return _Pose.apply((bare.mirrored,), False, None, *bare[:_TENSORS])[0]


class _Pose(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, mirrored: tuple[bool, ...], labels: bool, clip: Tensor | None, *tensors: Tensor | None
    ) -> tuple[Tensor, ...]:
        ctx.save_for_backward(clip, *tensors)
        ctx.mirrored, ctx.labels = mirrored, labels
        frames, subjects = _called(mirrored, tensors)
        means, quats, colors = map(
            torch.from_numpy, _raster.pose_forward(frames, subjects, array_or_none(clip), labels)
        )
        ctx.set_materialize_grads(False)
        means = means.view(frames, -1, 3)
        count = means.shape[1]
        if not len(quats):
            ctx.mark_non_differentiable(quats, colors)
            return means, quats, colors
        return means, quats.view(frames, count, 4), colors.view(frames, count, -1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulls: Tensor | None) -> tuple:
        clip, *tensors = ctx.saved_tensors
        wants_clip, *wants = ctx.needs_input_grad[2:]
        # Points, weights, bones, quats, albedo, and all of the light together; not parts and occlusion.
        wanted = [
            [*wants[at : at + 5], wants[at + 6] or wants[at + 8] or wants_clip]
            for at in range(0, len(wants), _TENSORS)
        ]
        frames, subjects = _called(ctx.mirrored, tensors)
        given = [array_or_none(pull) for pull in pulls]
        found, v_clip = _raster.pose_backward(
            frames, subjects, array_or_none(clip), ctx.labels, given, wanted
        )
        gradients = [value for own in found for value in (*own[:5], None, own[5], None, own[6])]
        return (
            None,
            None,
            shaped(v_clip, clip) if wants_clip else None,
            *(
                shaped(value, tensor) if want and value is not None else None
                for want, value, tensor in zip(wants, gradients, tensors, strict=True)
            ),
        )


def _called(mirrored: tuple[bool, ...], tensors: Sequence[Any]) -> tuple[int, list[Any]]:
    """The number of frames, and subjects as the compiled code takes them."""
    arrays = [array_or_none(tensor) for tensor in tensors]
    subjects = [
        (*arrays[at : at + _TENSORS], mirror)
        for mirror, at in zip(mirrored, range(0, len(arrays), _TENSORS), strict=True)
    ]
    return len(tensors[2]), subjects

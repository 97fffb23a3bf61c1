"""Canonical Gaussians carried to frames: each subject's bones and light, all subjects in one pass."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from bigs.fused.posing import Posing, pose
from bigs.models.canonical import CanonicalHand, CanonicalObject
from bigs.models.poses import ObjectFrames
from bigs.types import Gaussians, Side


class Covered(NamedTuple):
    """What surfaces nearby take of a subject's light; see `lighting`."""

    occlusion: Tensor  # [B, N] in [0, 1]
    ambient: Tensor  # [3]


class Part(NamedTuple):
    """One subject's N Gaussians in B frames."""

    posing: Posing
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]

    def lit(self, parts: Tensor, shade: Tensor, covered: Covered | None = None) -> Part:
        """With the shade [B, 4 + J] of its frames, and what covers it; parts [N, J] as in `lighting`."""
        # Light does not change how a hand bends.
        posing = self.posing._replace(parts=parts.detach(), shade=shade)
        if covered is not None:
            posing = posing._replace(occlusion=covered.occlusion, ambient=covered.ambient)
        return self._replace(posing=posing)


def hand_part(hand: CanonicalHand, points: Tensor, bones: Tensor, side: Side) -> Part:
    """A hand's Gaussians from shaped rest points [N, 3] or [B, N, 3] along the bones [B, 16, 4, 4]."""
    posing = Posing(points, hand.weights, bones, hand.quats, hand.colors, mirrored=side == "left")
    return Part(posing, hand.scales, hand.opacities)


def object_part(obj: CanonicalObject, frames: ObjectFrames) -> Part:
    """The object's Gaussians in its poses."""
    bones = torch.cat([frames.rotations, frames.centers[..., None]], dim=-1)[:, None]
    points, one = frames.scale * obj.means, obj.means.new_ones(len(obj.means), 1)
    return Part(Posing(points, one, bones, obj.quats, obj.colors), frames.scale * obj.scales, obj.opacities)


def pose_parts(parts: Iterable[Part], clip: Tensor | None = None, labels: bool = False) -> Gaussians:
    """All subjects as one set, in camera space: means [B, N, 3], quats [B, N, 4], colours [B, N, D].

    Args:
        parts: of the same frames; lit all or none.
        clip: [8, 3] the clip's light; without it colours are fixed, and [N, 3] if there are no labels.
        labels: whether colours go on with one channel for each part.
    """
    parts = list(parts)
    means, quats, colors = pose([part.posing for part in parts], clip, labels)
    if clip is None and not labels:
        colors = torch.cat([part.posing.albedo for part in parts])
    scales, opacities = (torch.cat([getattr(part, name) for part in parts]) for name in Part._fields[1:])
    return Gaussians(means, quats, scales, opacities, colors)

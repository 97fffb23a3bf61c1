"""Gaussians of the canonical subjects, before they are posed."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class CanonicalHand(NamedTuple):
    """N Gaussians of the right hand before shaping and posing."""

    points: Tensor  # [N, 3] metres, mean shape, rest pose
    shapedirs: Tensor  # [N, 3, 10]
    posedirs: Tensor | None  # [N, 3, 135]; None when the model has none
    weights: Tensor  # [N, 16]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    colors: Tensor  # [N, D]


class CanonicalObject(NamedTuple):
    """The object's Gaussians in its own frame, N of them."""

    means: Tensor  # [N, 3] metres at the initial size, offsets included
    offsets: Tensor  # [N, 3] what the field added to the start
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    colors: Tensor  # [N, 3]
    normals: Tensor  # [N, 3] unit
    weights: Tensor  # [N, 16] how far each belongs to the surface's regions; rows sum to one

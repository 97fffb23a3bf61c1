"""Gaussians of the canonical subjects, before they are posed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from torch import Tensor

# A layer of Gaussians covers pictures to so many of its standard deviations above its centres: lines of sight
# that graze it pass many, and each reaches further on screen than in space (`RasterSettings.eps2d`).
_REACH = 3.0


def below_surface(points: np.ndarray, normals: np.ndarray, thickness: np.ndarray) -> np.ndarray:
    """Where centres [N, 3] lie if a layer of Gaussians is to cover what the surface covers.

    On the surface itself they would draw a subject wider than it is, and poses would make up for it: hands
    would be drawn as too large, and put too far away, beside an object that need not shrink with them.

    Args:
        points: [N, 3] of the surface.
        normals: [N, 3] unit, outward.
        thickness: [N] standard deviations across the surface.
    """
    return points - _REACH * thickness[:, None] * normals


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

"""Contact between hands and object: the paper's pull of centres, and a pull of nearest surfaces."""

from __future__ import annotations

import torch
from torch import Tensor


def center_contact(object_centers: Tensor, wrists: Tensor, touching: Tensor) -> Tensor:
    """||Gamma_O - Gamma_H||_2 (paper Eq. 8) for one hand, a mean over the frames in which it touches.

    Args:
        object_centers, wrists: [B, 3] metres.
        touching: [B] in [0, 1].
    """
    distance = (object_centers - wrists).norm(dim=-1)
    return (distance * touching).sum() / touching.sum().clamp_min(1.0)


def deepest_mean(distances: Tensor, count: int) -> Tensor:
    """Mean [B] of the `count` smallest signed values of `distances` [B, V].

    Zero when the part of a hand that reaches furthest lies on the surface; the smallest *absolute* values
    would also be near zero for a hand that is stuck deep inside, where some vertices always cross it.
    """
    return distances.topk(min(count, distances.shape[1]), dim=1, largest=False).values.mean(1)


def surface_gaps(distances: Tensor, count: int = 30, reach: float = 0.01) -> Tensor:
    """How far the part of a hand that reaches furthest is from the object's surface, [B] in [0, 1).

    |d| / (|d| + reach) of its mean distance d: it saturates, so that a frame whose pose is wrong altogether
    does not outweigh the rest.

    Args:
        distances: [B, V] signed distances of the hand's vertices from the object, metres.
        count: how many vertices count as the touching part.
        reach: metres at which the pull has fallen by half.
    """
    depth = deepest_mean(distances, count).abs()
    return depth / (depth + reach)


def surface_contact(distances: Tensor, touching: Tensor, count: int = 30) -> Tensor:
    """Mean of `surface_gaps` over the frames that touch: draws the part that reaches furthest to the surface.

    Args:
        distances: [B, V] signed distances of the hand's vertices from the object, metres.
        touching: [B] in [0, 1], how sure it is that the hand touches the object.
        count: see `surface_gaps`.
    """
    return (surface_gaps(distances, count) * touching).sum() / touching.sum().clamp_min(1.0)


def penetration(distances: Tensor, tolerance: float = 0.001) -> Tensor:
    """Sum over vertices of max(-d - tolerance, 0)^2, a mean over frames, in centimetres squared.

    Args:
        distances: [B, V] signed distances d of the hand's vertices from the object, metres; negative inside.
        tolerance: depth in metres that costs nothing.
    """
    depth = 100.0 * torch.relu(-distances - tolerance)
    return depth.square().sum(1).mean()

"""Contact between hands and object: the paper's pull of centres, and a pull of nearest surfaces."""

from __future__ import annotations

from torch import Tensor


def center_contact(object_centers: Tensor, wrists: Tensor, touching: Tensor) -> Tensor:
    """||Gamma_O - Gamma_H||_2 (paper Eq. 8) for one hand, a mean over the frames in which it touches.

    Args:
        object_centers, wrists: [B, 3] metres.
        touching: [B] in [0, 1].
    """
    distance = (object_centers - wrists).norm(dim=-1)
    return (distance * touching).sum() / touching.sum().clamp_min(1.0)


def surface_gaps(depths: Tensor, reach: float = 0.01) -> Tensor:
    """How far the part of a hand that reaches furthest is from the object's surface, [...] in [0, 1).

    |d| / (|d| + reach) of its mean distance d: it saturates, so that a frame whose pose is wrong altogether
    does not outweigh the rest.

    Args:
        depths: [...] mean of the least signed distances of a hand's vertices, metres. It is zero when that
            part lies on the surface; the least *absolute* distances would also be near zero for a hand that
            is stuck deep inside, where some vertices always cross it.
        reach: metres at which the pull has fallen by half.
    """
    away = depths.abs()
    return away / (away + reach)


def surface_contact(depths: Tensor, touching: Tensor) -> Tensor:
    """Mean of `surface_gaps` over the frames that touch: draws the part that reaches furthest to the surface.

    Args:
        depths: [B] see `surface_gaps`.
        touching: [B] in [0, 1], how sure it is that the hand touches the object.
    """
    return (surface_gaps(depths) * touching).sum() / touching.sum().clamp_min(1.0)


def fingers_on_surface(depths: Tensor, holding: Tensor) -> Tensor:
    """Mean of `surface_gaps` over fingers and over the frames that hold: draws each to the surface by itself.

    Args:
        depths: [B, F] mean of the least signed distances of each fingertip's vertices, metres.
        holding: [B] in [0, 1], how sure it is that the hand holds the object.
    """
    fingers = max(depths.shape[1], 1)
    return (surface_gaps(depths).sum(dim=1) * holding).sum() / (fingers * holding.sum().clamp_min(1.0))


def penetration(sunk: Tensor) -> Tensor:
    """Squared depth of what is inside the object, a mean over frames, in centimetres squared.

    Args:
        sunk: [B] sum over the hand's vertices of their squared depths, metres squared.
    """
    return 1e4 * sunk.mean()

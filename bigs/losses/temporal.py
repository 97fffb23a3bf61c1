"""Smoothness over time. Frames are consecutive: the first axis is time."""

from __future__ import annotations

from torch import Tensor


def pose_steps(rotations: Tensor, positions: Tensor) -> Tensor:
    """The paper's L_smt (Eq. 6): squared change of pose and translation from frame to frame.

    Rotations differ by their matrices' Frobenius distance, which to first order is sqrt(2) times the angle
    and, unlike axis-angle differences, knows no jump at pi.

    Args:
        rotations: [T, J, 3, 3].
        positions: [T, 3] metres.
    """
    if len(rotations) < 2:
        return positions.sum() * 0.0
    turn = 0.5 * (rotations[1:] - rotations[:-1]).square().sum((-1, -2, -3))
    step = (positions[1:] - positions[:-1]).square().sum(-1)
    return (turn + step).mean()


def acceleration(points: Tensor) -> Tensor:
    """Mean squared second difference of points [T, N, 3] in centimetres per frame squared.

    Centimetres, so that an ordinary hand's values are near one.
    """
    if len(points) < 3:
        return points.sum() * 0.0
    second = 100.0 * (points[2:] - 2.0 * points[1:-1] + points[:-2])
    return second.square().sum(-1).mean()


def velocity(points: Tensor, together: Tensor) -> Tensor:
    """Mean squared step of points [T, N, 3], in centimetres, over the pairs of frames in `together` [T - 1].

    Given points in the object's frame and the pairs in which a hand holds it, this is the rigid-grasp term.
    """
    if len(points) < 2:
        return points.sum() * 0.0
    step = (100.0 * (points[1:] - points[:-1])).square().sum(-1).mean(-1)
    return (step * together).sum() / together.sum().clamp_min(1.0)

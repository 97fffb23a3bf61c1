"""Smoothness over time. Frames are consecutive: the first axis is time."""

from __future__ import annotations

from torch import Tensor


def pose_steps(rotations: Tensor, positions: Tensor) -> Tensor:
    """The paper's L_smt (Eq. 6): mean of ||R' - R||_F^2 / 2 + ||x' - x||^2 from a frame to the next (').

    The Frobenius distance of rotations is to first order sqrt(2) times their angle and, unlike axis-angle
    differences, knows no jump at pi.

    Args:
        rotations: [T, J, 3, 3], summed over J joints.
        positions: [T, 3] metres.
    """
    if len(rotations) < 2:
        return positions.sum() * 0.0
    turn = 0.5 * (rotations[1:] - rotations[:-1]).square().sum((-1, -2, -3))
    step = (positions[1:] - positions[:-1]).square().sum(-1)
    return (turn + step).mean()


def acceleration(points: Tensor) -> Tensor:
    """Mean of ||x_{t+1} - 2 x_t + x_{t-1}||^2 over points and frames, in centimetres squared per frame^4.

    Centimetres, so that an ordinary hand's values are near one.

    Args:
        points: [T, N, 3] metres.
    """
    if len(points) < 3:
        return points.sum() * 0.0
    second = 100.0 * (points[2:] - 2.0 * points[1:-1] + points[:-2])
    return second.square().sum(-1).mean()


def velocity(points: Tensor, together: Tensor) -> Tensor:
    """Mean of ||x_{t+1} - x_t||^2 over points and some pairs of frames, in centimetres squared.

    Given points in the object's frame and the pairs in which a hand holds it, this is the rigid-grasp term.

    Args:
        points: [T, N, 3] metres.
        together: [T - 1] weight of each pair of neighbouring frames, in [0, 1].
    """
    if len(points) < 2:
        return points.sum() * 0.0
    step = (100.0 * (points[1:] - points[:-1])).square().sum(-1).mean(-1)
    return (step * together).sum() / together.sum().clamp_min(1.0)

"""What keeps fields and poses plausible where images say nothing."""

from __future__ import annotations

import torch
from torch import Tensor


def color_spread(colors: Tensor) -> Tensor:
    """Mean over N colours c [N, 3] of ||c - mean c||_1 (the paper's L_color, Eq. 5)."""
    return (colors - colors.mean(0)).abs().mean(0).sum()


def scale_size(scales: Tensor) -> Tensor:
    """Mean over N Gaussians of ||s||^2 for standard deviations s [N, 3], metres (paper's L_scale, Eq. 5)."""
    return scales.square().sum() / len(scales)


def lbs_deviation(weights: Tensor, target: Tensor) -> Tensor:
    """||W - W_near||_F^2 / N (Eq. 6): skinning weights [N, J] against those of the 6 nearest vertices."""
    return (weights - target).square().sum() / len(weights)


def squared_norm(residuals: Tensor) -> Tensor:
    """Mean of ||r||^2 over residuals r [..., D], in their own unit squared: a normal prior around zero."""
    return residuals.square().sum() * (residuals.shape[-1] / residuals.numel())


# Second differences across the hand, index to ring and middle to pinky, of MANO's fingers: index, middle,
# pinky, ring and thumb.
_ACROSS = ((1.0, -2.0, 0.0, 1.0, 0.0), (0.0, 1.0, 1.0, -2.0, 0.0))


def finger_unevenness(hand_pose: Tensor) -> Tensor:
    """Mean of ||R_a - 2 R_b + R_c||_F^2 / 2 over a joint of three neighbouring fingers: squared radians.

    Tendons, and the shape of what a hand holds, bend fingers evenly from the index to the pinky, so a finger
    that nothing shows is expected to be the mean of those beside it. The thumb has no such neighbours.

    Args:
        hand_pose: rotations [T, 15, 3, 3] in MANO's joint order.
    """
    fingers = hand_pose.reshape(len(hand_pose), 5, -1)
    bend = hand_pose.new_tensor(_ACROSS) @ fingers
    return 0.5 * bend.square().sum() / (len(hand_pose) * 2 * 3)


def impossible_turn(hand_pose: Tensor, turns: Tensor) -> Tensor:
    """Mean squared sine of the turns that joints cannot make.

    Args:
        hand_pose: rotations [T, 15, 3, 3].
        turns: [M, 15, 3, 3], see `hand.impossible_turns`.
    """
    return (hand_pose.flatten(1) @ turns.flatten(1).T).square().mean()


# How far the outermost joint of a finger bends, of the joint before it: one tendon bends both.
_TOGETHER = 2.0 / 3.0
# Departures from that beyond this (radians) cost like themselves and not like their square: what a finger
# presses on bends its tip as it likes.
_PRESSED = 0.15


def uncoupled_bending(hand_pose: Tensor, bends: Tensor) -> Tensor:
    """Mean squared departure of outermost finger joints from two thirds of the joints before them.

    Squared radians, less for large ones (pseudo-Huber loss). The share is that of relaxed human fingers
    (Rijpkema and Girard, "Computer animation of knowledge-based human grasping", SIGGRAPH 1991).

    Args:
        hand_pose: rotations [T, 15, 3, 3].
        bends: [2, 2, 4, 15, 3, 3], see `hand.bends`.
    """
    sine, cosine = (hand_pose.flatten(1) @ bends.reshape(16, -1).T).reshape(-1, 2, 8).unbind(1)
    middle, outer = torch.atan2(sine, cosine).reshape(-1, 2, 4).unbind(1)
    away = (outer - _TOGETHER * middle) / _PRESSED
    return 2.0 * _PRESSED**2 * ((1.0 + away.square()).sqrt() - 1.0).mean()

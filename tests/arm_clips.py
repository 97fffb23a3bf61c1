"""A hand and its arm as boxes that cross the picture, with joints to match."""

from __future__ import annotations

import numpy as np

FRAMES, HEIGHT, WIDTH = 12, 90, 120
# Pixels are squares of 4 mm at the hand's distance.
K = np.array([[125.0, 0.0, WIDTH / 2], [0.0, 125.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
_DEPTH = 0.5
# Columns of the hand in the first frame: fingertips, wrist; the arm goes on to the picture's border.
_TIPS, _WRIST = 20, 55
_ROWS = slice(30, 48)


def hand_and_arm() -> tuple[np.ndarray, np.ndarray]:
    """Where the hand is, which moves right by a pixel a frame, and its arm: [T, H, W] bool each."""
    hand, arm = np.zeros((2, FRAMES, HEIGHT, WIDTH), dtype=bool)
    for t in range(FRAMES):
        hand[t, _ROWS, _TIPS + t : _WRIST + t] = True
        arm[t, _ROWS, _WRIST + t :] = True
    return hand, arm


def joints() -> np.ndarray:
    """[T, 21, 3] in camera space: all at the wrist but the middle finger's first, 9 cm before it."""
    found = np.zeros((FRAMES, 21, 3))
    middle = (_ROWS.start + _ROWS.stop) / 2
    for t in range(FRAMES):
        found[t] = np.linalg.inv(K) @ [_WRIST + t, middle, 1.0] * _DEPTH
        found[t, 4, 0] -= 0.09
    return found

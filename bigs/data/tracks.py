"""Filling the missing frames of a per-frame estimate: linear for vectors, along the arc for rotations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from bigs.checks import InputError

# Estimators add whole turns to an axis-angle; from here on float32 loses the angle itself.
MOST_TURN = 100.0


def check_turns(where: str, rotvecs: np.ndarray, valid: np.ndarray) -> None:
    """Raise `InputError` where an axis-angle [T, ..., 3] of a valid frame exceeds `MOST_TURN` radians."""
    turns = np.linalg.norm(rotvecs, axis=-1).reshape(len(rotvecs), -1).max(axis=1)
    wrong = np.flatnonzero(valid & (turns > MOST_TURN))
    if wrong.size:
        t = int(wrong[0])
        raise InputError(
            f"{where}: expected turns of at most {MOST_TURN:g} radians, found {turns[t]:.3g} in frame {t}"
        )


def fill_vectors(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Replace invalid rows by interpolating their valid neighbours; the ends repeat the nearest valid row.

    Args:
        values: [T, D]; invalid rows may be NaN.
        valid: [T] bool, at least one true.
    """
    frames = np.arange(len(valid))
    known = frames[valid]
    columns = [np.interp(frames, known, column[valid]) for column in values.T]
    return np.where(valid[:, None], values, np.stack(columns, axis=1))


def fill_rotations(rotvecs: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """The same for axis-angle rotations [T, J, 3], interpolated on SO(3)."""
    known = np.flatnonzero(valid)
    missing = np.flatnonzero(~valid)
    filled = rotvecs.copy()
    if missing.size == 0:
        return filled
    if known.size == 1:
        filled[missing] = rotvecs[known]
        return filled
    nearest = np.clip(missing, known[0], known[-1])
    for joint in range(rotvecs.shape[1]):
        arc = Slerp(known, Rotation.from_rotvec(rotvecs[known, joint]))
        filled[missing, joint] = arc(nearest).as_rotvec()
    return filled

"""Errors of a result against the truth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bigs.bench.workloads import PARAMETERS

COLUMNS = ("image", *PARAMETERS)

# A gradient with a smaller norm is zero up to rounding (rotations of isotropic Gaussians).
_ZERO = 1e-9


def relative_errors(
    truth: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray], leave_out: int = 0
) -> dict[str, float]:
    """Relative L2 error of the image and each gradient that `found` has.

    It is nan where the true array is zero, and inf where the found one is not finite. `leave_out` pixels and
    Gaussians, of each array those furthest off, do not count: where a pair lies at a threshold, both sides of
    it are right.
    """
    errors = {}
    for name in COLUMNS:
        if name in found:
            right, other = (np.asarray(x[name], np.float64) for x in (truth, found))
            norm = np.linalg.norm(right)
            error = _without_worst(other - right, leave_out) / norm if norm > _ZERO else np.nan
            errors[name] = float(error) if np.isfinite(other).all() else np.inf
    return errors


def _without_worst(difference: np.ndarray, leave_out: int) -> float:
    rows = difference.reshape(-1, difference.shape[-1]) if difference.ndim > 1 else difference[:, None]
    squares = np.sort((rows**2).sum(-1))
    return float(np.sqrt(squares[: max(len(squares) - leave_out, 0)].sum()))

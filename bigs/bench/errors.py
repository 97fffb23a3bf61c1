"""How far a result lies from the truth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bigs.bench.workloads import PARAMETERS

COLUMNS = ("image", *PARAMETERS)

# A gradient with a smaller norm is zero up to rounding (rotations of isotropic Gaussians).
_ZERO = 1e-9


def relative_errors(truth: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Relative L2 error of the image and each gradient that `found` has.

    It is nan where the true array is zero, and inf where the found one is not finite.
    """
    errors = {}
    for name in COLUMNS:
        if name in found:
            right, other = (np.asarray(x[name], np.float64) for x in (truth, found))
            norm = np.linalg.norm(right)
            error = float(np.linalg.norm(other - right)) / norm if norm > _ZERO else np.nan
            errors[name] = float(error) if np.isfinite(other).all() else np.inf
    return errors

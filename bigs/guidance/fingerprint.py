"""A fingerprint of a denoiser, independent of where its files lie."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

from torch import Tensor

# This many values of each tensor enter, evenly spread: whole networks take long to read, and two trainings
# differ everywhere.
_VALUES = 1024


def fingerprint(weights: Mapping[str, Tensor], settings: object) -> str:
    """16 hexadecimal digits that depend on named weights and on all that `repr(settings)` shows."""
    digest = hashlib.sha256(repr(settings).encode())
    for name, values in weights.items():
        digest.update(f"{name} {values.dtype} {tuple(values.shape)}".encode())
        flat = values.detach().reshape(-1)
        digest.update(flat[:: max(1, len(flat) // _VALUES)].float().cpu().numpy().tobytes())
    return digest.hexdigest()[:16]

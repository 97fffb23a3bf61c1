"""A few of many, evenly."""

from __future__ import annotations

import numpy as np


def spread(count: int, most: int) -> np.ndarray:
    """Up to `most` of the indices below `count`, evenly, the first and the last among them: int [N]."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)

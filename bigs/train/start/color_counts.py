"""How often colours were seen, to tell what a pixel shows by its colour."""

from __future__ import annotations

import numpy as np
import scipy.ndimage

# Cells along each channel.
_CELLS = 16
# Neighbours within some pixels decide together.
_NEIGHBOURHOOD = 2.0


def color_counts(colors: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """How often each of the colours [..., 3], in [0, 1], counts with its weight [...]: a smooth histogram."""
    counts = np.zeros((_CELLS,) * 3)
    np.add.at(counts, color_cells(colors), weights)
    return scipy.ndimage.gaussian_filter(counts, 1.0, mode="constant")


def color_cells(colors: np.ndarray) -> tuple[np.ndarray, ...]:
    """The cells of the histogram that colours [..., 3] fall into, an index array for each channel."""
    return tuple(np.moveaxis((colors * _CELLS).astype(int).clip(0, _CELLS - 1), -1, 0))


def smoothed(values: np.ndarray) -> np.ndarray:
    """Values [H, W] averaged over the neighbours that decide with a pixel."""
    return scipy.ndimage.gaussian_filter(values, _NEIGHBOURHOOD)

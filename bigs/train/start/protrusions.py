"""Parts of an object that its masks show beyond the hull of its points, such as a handle without texture."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_opening, distance_transform_edt

from bigs.geometry.coverage import ObjectViews
from bigs.threads import side_by_side

# Most frames that are asked, and the share of them, and number, that must show a place beside the rest.
_MOST_FRAMES = 24
_LEAST_SHARE, _LEAST_FRAMES = 0.15, 3
# Edges of masks are off by so many pixels, and what is thinner than this across says nothing.
_EDGE, _THIN = 2.0, 3
# Corners of a grid stand for so much around them, in cells.
_AROUND = 0.9


def protruding(views: ObjectViews, places: np.ndarray, solid: np.ndarray, spacing: float) -> np.ndarray:
    """Which places [N] (bool) masks show to be the object's although they are outside of what is known of it.

    In some frames they lie before the background, well beside the known part. One frame leaves open how far
    away they are, so several must agree.

    Args:
        views: the frames that show the object.
        places: [N, 3] metres, which no mask contradicts.
        solid: [M, 3] corners of a grid inside the known part.
        spacing: of that grid, metres.
    """
    count = len(views.shown)
    frames = np.unique(np.linspace(0, count - 1, min(count, _MOST_FRAMES)).astype(int))
    if not len(places) or not len(solid):
        return np.zeros(len(places), dtype=bool)
    beside = side_by_side(lambda t: _beside(views, t, places, solid, spacing), frames)
    return np.sum(beside, axis=0) >= max(_LEAST_FRAMES, _LEAST_SHARE * len(frames))


def _beside(views: ObjectViews, t: int, places: np.ndarray, solid: np.ndarray, spacing: float) -> np.ndarray:
    """Which places [N] (bool) frame t shows as the object's where the known part does not show."""
    row, column, depth, inside = views.pixels(t, solid)
    shown = views.shown[t]
    nowhere = np.zeros(len(places), dtype=bool)
    if not inside.any() or not shown.any():
        return nowhere
    reach = _AROUND * spacing * views.K[0, 0] / float(np.median(depth[inside])) + _EDGE
    pad = int(reach) + 1
    around = tuple(slice(max(axis.min() - pad, 0), axis.max() + pad + 1) for axis in np.nonzero(shown))
    free = np.ones(shown.shape, dtype=bool)
    free[row[inside], column[inside]] = False
    if free[around].all():
        return nowhere
    unexplained = np.zeros(shown.shape, dtype=bool)
    unexplained[around] = binary_opening(
        shown[around] & (distance_transform_edt(free[around]) > reach), np.ones((_THIN, _THIN))
    )
    row, column, _, inside = views.pixels(t, places)
    return inside & unexplained[row, column]

"""How far an object reaches beyond its points on the side that no camera looked at.

Silhouettes of few directions leave that side open by much more than the object is deep. What bounds it is
what they show: a side seen at a glancing angle, a corner that the points do not reach.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_erosion, maximum_filter, minimum_filter

from bigs.geometry.coverage import ObjectViews
from bigs.threads import side_by_side

# Depths among which it is looked for, metres, and most frames that are asked.
_DEPTHS = np.linspace(0.0, 0.1, 101)
_MOST_FRAMES = 48


def far_side_depth(
    views: ObjectViews, places: np.ndarray, beyond: np.ndarray, spacing: float, price: float
) -> float:
    """The depth, metres, that explains most of the object's pixels for what it costs.

    Args:
        views: the frames that show the object.
        places: [N, 3] metres, on a grid, where the object may be.
        beyond: [N] metres by which each lies beyond the object's points; not positive where it does not.
        spacing: of the grid, metres.
        price: how wide a strip along the whole outline a unit of depth has to explain on average.
    """
    count = len(views.shown)
    frames = np.unique(np.linspace(0, count - 1, min(count, _MOST_FRAMES)).astype(int))
    unexplained = side_by_side(lambda t: _unexplained(views, t, places, beyond, spacing), frames)
    return float(_DEPTHS[np.argmin(np.mean(unexplained, axis=0) + price * _DEPTHS)])


def _unexplained(
    views: ObjectViews, t: int, places: np.ndarray, beyond: np.ndarray, spacing: float
) -> np.ndarray:
    """What of the object's pixels in frame t no place of less than each of `_DEPTHS` lies on.

    As the width of a strip along the whole outline, metres.
    """
    row, column, depth, inside = views.pixels(t, places)
    shown = views.shown[t]
    if not inside.any() or not shown.any():
        return np.zeros(len(_DEPTHS))
    pixel = float(np.median(depth[inside])) / views.K[0, 0]
    (top, bottom), (left, right) = ((axis.min(), axis.max() + 1) for axis in np.nonzero(shown))
    least = np.full(shown.shape, np.inf)
    np.minimum.at(least, (row[inside], column[inside]), beyond[inside])
    # As wide as the grid is coarse, and back by as much.
    width = int(np.ceil(spacing / pixel)) | 1
    around = slice(max(top - width, 0), bottom + width), slice(max(left - width, 0), right + width)
    least = maximum_filter(minimum_filter(least[around], width), width)
    # At the very edge half a pixel decides.
    needed = np.sort(least[binary_erosion(shown)[around]])
    count = len(needed) - np.searchsorted(needed, _DEPTHS, side="right")
    return count * pixel / (4.0 * np.sqrt(shown.sum()))

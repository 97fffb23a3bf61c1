"""Pictures that repeat the one before: cameras that slow down in dim light, recorders that fill in frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from bigs.data.base import Clip
from bigs.threads import side_by_side

# Every so manyth pixel of these tells.
_STEP = 4
# A repeated picture differs from the one before, as compression leaves it, by at most this share of what
# pictures between which most moves differ by.
_SAME = 0.1
_MOVING = 90.0  # percentile
# Where more than this share of so many pictures at the start are new, the others need no look.
_MANY, _FIRST = 0.75, 13
# Of so many pictures in a row one is new, at most; slower clips have a rate of their own.
_MOST = 4
# Share of new pictures that follow each other at that distance, at least.
_REGULAR = 0.9


def with_repeats_noted(clip: Clip) -> Clip:
    """The clip with a note where only every second to fourth of its pictures is new."""
    every = every_new(clip.image_as_taken, len(clip))
    if every == 1:
        return clip
    note = (
        f"pictures: of {every} in a row one is new and the rest repeat it; without them (bigs convert "
        f"--every {every}) a run is faster and better"
    )
    return replace(clip, notes=(*clip.notes, note))


def every_new(picture: Callable[[int], np.ndarray], count: int) -> int:
    """Of how many pictures in a row one is new, and repeated by the rest; 1 where most are new.

    Args:
        picture: gives picture t, [H, W, 3] uint8.
        count: how many there are.
    """
    if count <= _FIRST or _is_new(picture, _FIRST).mean() > _MANY:
        return 1
    distances = np.diff(np.flatnonzero(_is_new(picture, count)))
    if len(distances) == 0:
        return 1
    every = int(np.median(distances))
    return every if every <= _MOST and (distances == every).mean() >= _REGULAR else 1


def _is_new(picture: Callable[[int], np.ndarray], count: int) -> np.ndarray:
    """Which pictures differ from the one before, from the second on: [count - 1] bool."""
    small = side_by_side(lambda t: picture(t)[::_STEP, ::_STEP].astype(np.int16), range(count))
    differences = np.array([np.abs(after - before).mean() for before, after in pairwise(small)])
    return differences > _SAME * np.percentile(differences, _MOVING)

"""How many frames a second a clip has that does not say."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import PurePath
from statistics import median

from bigs.types import USUAL_FPS

# Larger steps are no frames that were left out: numbers may be times, or of other pictures.
_LARGEST_STEP = 10


def rate_by_names(names: Sequence[str]) -> float:
    """The usual rate, divided by the step in which names number the frames of a video.

    Who keeps every third frame of a video keeps its number, too.

    Args:
        names: of all frames, in order.
    """
    numbers = [re.findall(r"\d+", PurePath(name).stem) for name in names]
    if len(names) < 2 or not all(numbers):
        return USUAL_FPS
    # Not as integers, which a name of thousands of digits cannot be made.
    steps = [after - before for before, after in pairwise(float(found[-1]) for found in numbers)]
    usual = median(steps)
    if min(steps) <= 0 or not 1 <= usual <= _LARGEST_STEP:
        return USUAL_FPS
    return USUAL_FPS / usual

"""Pictures that are darker than cameras usually leave them.

What steps weigh against each other, and which colours count as different, is said for pictures that use the
range of their files. In dark ones the same errors are smaller numbers.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bigs.data.base import Clip
from bigs.geometry.spread import spread
from bigs.threads import side_by_side
from bigs.types import MASK_VALUES

# Every so many pixels of so many frames tell.
_STEP, _FRAMES = 4, 16
# How bright pictures are: this percentile of their pixels' brightest channels, of all pixels or of hands and
# object if those are brighter.
_PERCENTILE = 98.0
# The level, in [0, 1], that well exposed pictures reach, and the one below which pictures are dark.
_USUAL, _DARK = 0.9, 0.7
# Pictures of a lower level show nothing.
_BLACK = 0.02


def brightened(clip: Clip) -> Clip:
    """The clip with dark pictures as bright as usual, and with them the colours of its object's points."""
    level = _level(clip)
    if not _BLACK < level < _DARK:
        return clip
    brightness, track = level / _USUAL, clip.object
    if track is not None and track.colors is not None:
        track = replace(track, colors=np.minimum(track.colors / brightness, 1.0))
    return replace(clip, brightness=brightness, object=track)


def _level(clip: Clip) -> float:
    """How bright a clip's pictures are, in [0, 1]."""
    frames = spread(len(clip), _FRAMES).tolist()
    brightest = np.stack(side_by_side(lambda t: clip.image(t)[::_STEP, ::_STEP].max(-1), frames))
    labels = np.stack(side_by_side(lambda t: clip.mask(t)[::_STEP, ::_STEP], frames))
    shown = brightest[np.isin(labels, list(MASK_VALUES.values()))]
    levels = [np.percentile(pixels, _PERCENTILE) for pixels in (brightest, shown) if pixels.size]
    return float(max(levels)) / 255.0

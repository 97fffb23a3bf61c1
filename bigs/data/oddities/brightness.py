"""Pictures that are darker or paler than cameras usually leave them.

What steps weigh against each other, and which colours count as different, is said for pictures that use the
range of their files. In dark ones the same errors are smaller numbers. So they are in pale ones, in which
nothing is black, such as through haze or in a camera's flat colours.
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
# What they have for black: this percentile of all pixels' darkest channels, if it is higher than this.
_BLACK_PERCENTILE, _PALE = 0.5, 0.15
# The range of levels, in [0, 1], that well exposed pictures have, and the one below which they lack it.
_USUAL, _NARROW = 0.9, 0.7
# Pictures of a narrower range show nothing.
_NOTHING = 0.02


def brightened(clip: Clip) -> Clip:
    """The clip with dark and pale pictures as usual, and with them the colours of its object's points."""
    black, white = _levels(clip)
    if not _NOTHING < white - black < _NARROW:
        return clip
    brightness, track = (white - black) / _USUAL, clip.object
    if track is not None and track.colors is not None:
        track = replace(track, colors=np.clip((track.colors - black) / brightness, 0.0, 1.0))
    return replace(clip, black=black, brightness=brightness, object=track)


def _levels(clip: Clip) -> tuple[float, float]:
    """What a clip's pictures have for black and for white, in [0, 1]."""
    frames = spread(len(clip), _FRAMES).tolist()
    images = np.stack(side_by_side(lambda t: clip.image(t)[::_STEP, ::_STEP], frames))
    labels = np.stack(side_by_side(lambda t: clip.mask(t)[::_STEP, ::_STEP], frames))
    brightest, darkest = images.max(-1), images.min(-1)
    shown = brightest[np.isin(labels, list(MASK_VALUES.values()))]
    whites = [np.percentile(pixels, _PERCENTILE) for pixels in (brightest, shown) if pixels.size]
    black = float(np.percentile(darkest, _BLACK_PERCENTILE)) / 255.0
    return black if black > _PALE else 0.0, float(max(whites)) / 255.0

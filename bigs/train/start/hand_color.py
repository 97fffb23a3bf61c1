"""The colour that the pictures show of the hands: fair or dark skin, or a glove."""

from __future__ import annotations

import numpy as np

from bigs.data.base import Clip
from bigs.geometry.spread import spread
from bigs.types import MASK_VALUES

# So many frames, evenly over the clip, tell; and only the darkest and brightest colours are kept off the ends
# of [0, 1], which a Gaussian's colour does not reach.
_FRAMES = 16
_MARGIN = 0.02


def hand_color(clip: Clip) -> tuple[float, float, float] | None:
    """The median of the pixels labelled as either hand, RGB in (0, 1); None if there is none.

    Until a hand's colour has followed the pictures, steps that compare colours pull at its pose.
    """
    labels = [MASK_VALUES[side] for side in clip.hands]
    frames = spread(len(clip), _FRAMES)
    pixels = np.concatenate([clip.image(t)[np.isin(clip.mask(t), labels)] for t in frames])
    if len(pixels) == 0:
        return None
    red, green, blue = (np.median(pixels, axis=0) / 255.0).clip(_MARGIN, 1.0 - _MARGIN).tolist()
    return red, green, blue

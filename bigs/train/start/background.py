"""Background pixels that show unlabelled occluders: sleeves, arms, other people.

Masks label a sleeve as background, yet it hides a hand as an object does. With a camera that stands still the
background is the same in every frame, so whatever differs from its median over time is an unknown occluder.
"""

from __future__ import annotations

import numpy as np
import scipy.ndimage
import torch

from bigs.data.base import Clip

# Colours (in [0, 1]) that differ by more than this belong to different surfaces; noise and soft shadows
# differ less.
_THRESHOLD = 0.06
# Long side in pixels at which frames are compared: occluders are large, and a clip then fits in memory.
_SIZE = 320
# Half the width, in compared pixels, of holes that are closed.
_CLOSE = 5
# If more of the background moves than this, the camera moves or the light changes, and nothing is known.
_USELESS_SHARE = 0.5


def unknown_occluders(clip: Clip) -> np.ndarray:
    """Where an unlabelled occluder may hide a hand or the object.

    Returns:
        [T, H, W] bool at the clip's size; all False when the background does not stand still.
    """
    step = max(1, -(-max(clip.width, clip.height) // _SIZE))
    images = np.stack([clip.image(t)[::step, ::step] for t in range(len(clip))])
    background = np.stack([clip.mask(t)[::step, ::step] for t in range(len(clip))]) == 0
    unknown = np.zeros(background.shape, dtype=bool)
    for row in range(images.shape[1]):  # a row at a time: the median's copy in floats is large
        values = np.where(background[:, row, :, None], images[:, row] / np.float32(255.0), np.float32(np.nan))
        seen = background[:, row].any(axis=0)
        median = np.zeros(values.shape[1:], dtype=np.float32)
        median[seen] = np.nanmedian(values[:, seen], axis=0)
        unknown[:, row] = (np.abs(values - median) > _THRESHOLD).any(axis=-1) & background[:, row]
    if unknown.sum() > _USELESS_SHARE * background.sum():
        return np.zeros((len(clip), clip.height, clip.width), dtype=bool)
    # Mask borders mix two colours in one pixel; an occluder is wider than that.
    cross = scipy.ndimage.generate_binary_structure(2, 1)[None]
    unknown = scipy.ndimage.binary_opening(unknown, cross, iterations=1)
    unknown = scipy.ndimage.binary_dilation(unknown, cross, iterations=2) & background
    # An occluder with the background's colour here and there has holes, and one pixel's hole carves a tunnel
    # through the visual hull, so holes between unknown and known pixels are closed.
    padded = np.pad(unknown | ~background, ((0, 0), (_CLOSE, _CLOSE), (_CLOSE, _CLOSE)), mode="edge")
    closed = scipy.ndimage.binary_closing(padded, cross, iterations=_CLOSE)[:, _CLOSE:-_CLOSE, _CLOSE:-_CLOSE]
    near = scipy.ndimage.binary_dilation(unknown, cross, iterations=2 * _CLOSE)
    unknown |= closed & near & background
    return unknown.repeat(step, axis=1).repeat(step, axis=2)[:, : clip.height, : clip.width]


def share_per_pixel(masks: np.ndarray, height: int, width: int) -> torch.Tensor:
    """Masks [T, H, W] (bool) as shares [T, height, width] of smaller pixels."""
    return torch.cat(
        [
            torch.nn.functional.interpolate(
                torch.from_numpy(mask)[None, None].float(), (height, width), mode="bilinear", antialias=True
            )
            for mask in masks
        ]
    )[:, 0]

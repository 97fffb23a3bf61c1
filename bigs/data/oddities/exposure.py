"""Exposure that wavers: cameras make single frames brighter, darker or warmer than the rest of a clip.

A background that stands still tells by how much, and frames are brought to one exposure before anything is
fitted to them: the Gaussians of a run have one brightness.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bigs.data.base import Clip
from bigs.data.oddities.brightness import brightened
from bigs.threads import side_by_side

# Long side in pixels at which frames are compared, and the sides of the cells whose means are compared: noise
# of single pixels is as large as what wavers.
_SIZE, _CELL = 160, 8
# How often what is usual and how frames differ from it are found in turn.
_ROUNDS = 3
# A clip none of whose frames differs by more than this share has one exposure.
_STEADY = 0.02
# Brightness, in [0, 1], of pixels that tell: darker ones are noise, brighter ones are cut off.
_TELLING = (0.1, 0.95)
# A frame differs if it does so by this many times as much as its cells contradict each other.
_CLEARLY = 3.0
# The least share of a cell that must show telling background.
_LEAST_SHARE = 0.25
# Fewer cells are no background.
_LEAST_CELLS = 8


def with_one_exposure(clip: Clip) -> Clip:
    """The clip with what makes each frame brighter or darker than usual, which `Clip.image` takes out.

    Args:
        clip: with masks. Where its background moves nothing is known, and nothing changes.
    """
    if not clip.mask_paths:
        return clip
    step = max(1, -(-max(clip.width, clip.height) // _SIZE))
    frames = range(len(clip))
    bright = brightened(clip)
    # Exposure also multiplies what a pale picture has for black.
    shown = bright if bright.black == 0.0 else clip
    images = np.stack(side_by_side(lambda t: shown.image(t)[::step, ::step], frames))
    background = np.stack(side_by_side(lambda t: clip.mask(t)[::step, ::step] == 0, frames))
    gains = _gains(images, background)
    if not (np.abs(gains - 1.0) > _STEADY).any():
        return clip
    low, high = gains.mean(1).min(), gains.mean(1).max()
    note = f"exposure: frames are {low:.2f} to {high:.2f} times as bright as usual; brought to one exposure"
    return replace(clip, gains=gains, notes=(*clip.notes, note))


def _gains(images: np.ndarray, background: np.ndarray) -> np.ndarray:
    """How many times as bright as usual the channels of images [T, H, W, 3] are where they show background.

    Returns:
        [T, 3]; 1 where nothing is known.
    """
    gains = np.ones((len(images), 3), dtype=np.float32)
    # What a pixel usually shows depends on the frames that show it, until they have one exposure.
    for _ in range(_ROUNDS):
        usual = np.zeros(images.shape[1:], dtype=np.float32)
        for row in range(images.shape[1]):  # a row at a time: copies in floats are large
            colors = images[:, row] / gains[:, None]
            usual[row] = median_over_time(np.where(background[:, row, :, None], colors, np.float32(np.nan)))
        pairs = zip(images, background, strict=True)
        gains = np.stack([_gain(image, shown, usual) for image, shown in pairs])
        if not (np.abs(gains - 1.0) > _STEADY).any():
            break
    return gains / np.median(gains, axis=0)


def _gain(image: np.ndarray, background: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """The gain [3] of one image [H, W, 3] over what its background [H, W] usually shows [H, W, 3].

    It is the median over cells, of which unlabelled things that move cover less than half; 1 where cells
    contradict each other, as they do when the camera moves.
    """
    dark, bright = (255.0 * value for value in _TELLING)
    chosen = background & ((usual > dark) & (usual < bright) & (image < bright)).all(-1)
    cells = _cell_sums(chosen) >= _LEAST_SHARE * _CELL**2
    nothing = np.ones(3, dtype=np.float32)
    if cells.sum() < _LEAST_CELLS:
        return nothing
    now, before = (_cell_sums(np.where(chosen[..., None], look, 0.0))[cells] for look in (image, usual))
    ratios = (now / before).astype(np.float32)
    gain = np.median(ratios, axis=0)
    contradiction = np.median(np.abs(ratios - gain))
    return gain if np.abs(gain - 1.0).max() > _CLEARLY * contradiction else nothing


def median_over_time(values: np.ndarray) -> np.ndarray:
    """Median [W, 3] over time of values [T, W, 3] without those that are NaN; 0 where all are."""
    # NaN comes last; `nanmedian` takes several times as long.
    ordered = np.sort(values, axis=0)
    count = (~np.isnan(values)).sum(axis=0)
    middle = [np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(values) - 1)]
    lower, upper = (np.take_along_axis(ordered, index[None], axis=0)[0] for index in middle)
    return np.where(count > 0, (lower + upper) / 2, np.zeros((), dtype=values.dtype))


def _cell_sums(values: np.ndarray) -> np.ndarray:
    """Sums [h, w, ...] of values [H, W, ...] over cells; a rest at the border is left out."""
    rows, columns = values.shape[0] // _CELL, values.shape[1] // _CELL
    whole = values[: rows * _CELL, : columns * _CELL]
    return whole.reshape(rows, _CELL, columns, _CELL, *values.shape[2:]).sum((1, 3))

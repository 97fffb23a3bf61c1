"""Background pixels that show unlabelled occluders: sleeves, arms, other people.

Masks label a sleeve as background, yet it hides a hand as an object does. With a camera that stands still the
background is the same in every frame, so whatever differs from it, and is no shadow on it, is an unknown
occluder. What a pixel shows most of the time need not be the background: it may be a forearm that hardly
moves. Where a pixel shows two colours, the one that the clip's occluders have elsewhere belongs to an
occluder, and where arms may always be and nothing but their colours shows, no frame shows the background. A
camera that shakes is held still first (see `shake`). Before a background that moves otherwise only arms are
looked for (see `arms`), and masks that were lost: what they showed may still be there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy.ndimage

from bigs.data.base import Clip
from bigs.data.oddities.exposure import median_over_time
from bigs.motion.masks import short_gaps
from bigs.threads import side_by_side
from bigs.train.start.arms import arm_reach, arms, cuff_reach, cuffs_like_background
from bigs.train.start.color_counts import color_cells, color_counts, smoothed
from bigs.train.start.shake import SteadyView, steady_view
from bigs.types import MASK_VALUES, Side

# Colours (in [0, 1]) that differ by more than this belong to different surfaces; noise and soft shadows
# differ less.
_THRESHOLD = 0.06
# A shadow leaves at least this share of the light, ...
_SHADED = 0.3
# ... and as much of red, green and blue, to this share of it. Black says nothing of shares.
_TINT, _BLACK = 0.1, 0.02
# Long side in pixels at which frames are compared: occluders are large, and a clip then fits in memory.
_SIZE = 320
# A pixel that shows something else in this share of its frames may show an occluder in most of them.
_CONTESTED_SHARE = 0.05
# Rounds of counting colours of occluders and background, and of deciding.
_ROUNDS = 8
# An arm may hide a pixel in the whole clip if it reaches it in this share of frames; estimates err in some.
_ALWAYS = 0.75
# How far, in compared pixels, a subject may have moved beyond where the frames around show it.
_MOVED = 10
# Half the width, in compared pixels, of holes that are closed.
_CLOSE = 5
# If more of the background differs where no arm reaches, the camera moves or the light changes.
_MOVING_SHARE = 0.05


class Occluders(NamedTuple):
    """What may hide hands and object without a label."""

    pixels: np.ndarray  # [T, H, W] bool at the clip's size
    moving: str | None  # how the background moves before which they were found; None: it stands still


def unknown_occluders(clip: Clip, joints: Mapping[Side, np.ndarray]) -> Occluders:
    """Where an unlabelled occluder may hide a hand or the object.

    Args:
        clip: with masks.
        joints: [T, 21, 3] of each hand in camera space, as estimated.

    Returns:
        Before a background that neither stands still nor turns as the camera does, only arms and what masks
        lost.
    """
    step = max(1, -(-max(clip.width, clip.height) // _SIZE))
    frames = range(len(clip))
    images = np.stack(side_by_side(lambda t: clip.image(t)[::step, ::step], frames))
    labels = np.stack(side_by_side(lambda t: clip.mask(t)[::step, ::step], frames))
    background = labels == 0
    K = np.diag([1.0 / step, 1.0 / step, 1.0]) @ clip.K
    reach = arm_reach(joints, K, labels.shape)
    near = _Near(reach, cuff_reach(joints, K, labels.shape))
    differs, moving = _differing(images, background, near), None
    if _moves(differs, background, reach):
        moving = "turns, as the camera does"
        differs = _differing_before(steady_view(images, background, K), images, background, near)
    if _moves(differs, background, reach):
        moving = "moves, so that what hides hands is known only where arms may be"
        unknown = _lost(labels) | _whole(arms(images, background, reach, joints, K), background)
    else:
        unknown = _whole(differs | cuffs_like_background(images, differs, background, joints, K), background)
    if clip.arms is not None:
        unknown |= np.stack(side_by_side(lambda t: clip.arm(t)[::step, ::step], frames))
    whole = unknown.repeat(step, axis=1).repeat(step, axis=2)[:, : clip.height, : clip.width]
    return Occluders(whole, moving)


class _Near(NamedTuple):
    """Where arms may be; bool [T, H, W]."""

    arms: np.ndarray
    cuffs: np.ndarray  # where a sleeve may look like a shadow


class _Still(NamedTuple):
    """The background that stands still."""

    colors: np.ndarray  # [H, W, 3] in [0, 1]
    hidden: np.ndarray  # [H, W] bool, where hardly a frame shows it, and `colors` are an occluder's
    odds: np.ndarray  # by the colour's cell, logarithm: how much more often it is an occluder's


def _differing(images: np.ndarray, background: np.ndarray, near: _Near) -> np.ndarray:
    """Where the background [T, H, W] of images [T, H, W, 3] is not what stands still: bool.

    Shadows on it only count in cuffs.
    """
    still = _still_background(_looks(images, background), _always(near.arms, background))
    # A frame at a time: the whole clip in floats is large.
    frames = zip(images, near.cuffs, strict=True)
    return background & np.stack([_unlike(_floats(image), still, cuffs) for image, cuffs in frames])


def _differing_before(
    view: SteadyView, images: np.ndarray, background: np.ndarray, near: _Near
) -> np.ndarray:
    """The same where the camera turns."""
    shown = view.gathered(background)
    still = _still_background(_looks(view.gathered(images), shown), _always(view.gathered(near.arms), shown))
    found = []
    for t, (image, cuffs) in enumerate(zip(images, near.cuffs, strict=True)):
        colors, hidden = (
            view.shown_in(t, values, cuffs.shape)
            for values in (still.colors, still.hidden.astype(np.float32))
        )
        seen = still._replace(colors=colors, hidden=hidden > 0.5)
        found.append(_unlike(_floats(image), seen, cuffs))
    return background & np.stack(found)


def _always(arms: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Pixels [H, W] where arms may be nearly always when masks [T, H, W] say background."""
    return (arms & background).sum(axis=0) > _ALWAYS * background.sum(axis=0)


def _unlike(colors: np.ndarray, still: _Still, cuffs: np.ndarray) -> np.ndarray:
    """Where colours [H, W, 3] are not the background's; nowhere where its own are not a number."""
    differs = (np.abs(colors - still.colors) > _THRESHOLD).any(axis=-1)
    differs &= cuffs | ~_shaded(colors, still.colors)
    return np.where(still.hidden, smoothed(still.odds[color_cells(colors)]) > 0.0, differs)


def _shaded(colors: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Where colours [H, W, 3] are the background's with less light, or with more if it is usually shaded."""
    shares = (colors + _BLACK) / (still + _BLACK)
    low, high = shares.min(axis=-1), shares.max(axis=-1)
    return (low > _SHADED) & (high < 1.0 / _SHADED) & (high - low < _TINT * high)


def _moves(differs: np.ndarray, background: np.ndarray, reach: np.ndarray) -> bool:
    """Whether the background moves: whether much of it differs beyond the reach of arms."""
    beyond = background & ~reach
    return bool(differs[beyond].sum() > _MOVING_SHARE * beyond.sum())


def _whole(unknown: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Occluders [T, H, W] without crumbs at mask borders and without holes."""
    # Mask borders mix two colours in one pixel; an occluder is wider than that.
    cross = scipy.ndimage.generate_binary_structure(2, 1)[None]
    unknown = scipy.ndimage.binary_opening(unknown, cross, iterations=1)
    unknown = scipy.ndimage.binary_dilation(unknown, cross, iterations=2) & background
    # An occluder with the background's colour here and there has holes, and one pixel's hole carves a tunnel
    # through the visual hull, so holes between unknown and known pixels are closed.
    padded = np.pad(unknown | ~background, ((0, 0), (_CLOSE, _CLOSE), (_CLOSE, _CLOSE)), mode="edge")
    closed = scipy.ndimage.binary_closing(padded, cross, iterations=_CLOSE)[:, _CLOSE:-_CLOSE, _CLOSE:-_CLOSE]
    near = scipy.ndimage.binary_dilation(unknown, cross, iterations=2 * _CLOSE)
    return unknown | (closed & near & background)


def _lost(labels: np.ndarray) -> np.ndarray:
    """Where in the background of masks [T, H, W] a subject may be whose own mask a few frames lack: bool.

    Masks say of such a frame that the subject is elsewhere, and it would be fitted to that. A frame without
    any mask says nothing at all.
    """
    lost = np.zeros(labels.shape, dtype=bool)
    for value in MASK_VALUES.values():
        own = labels == value
        for before, after in short_gaps(own.any(axis=(1, 2))):
            around = own[before] | own[after]
            lost[before + 1 : after] |= scipy.ndimage.binary_dilation(around, iterations=_MOVED)
    lost[~labels.any(axis=(1, 2))] = True
    return lost & (labels == 0)


class _Looks(NamedTuple):
    """What each pixel shows where the masks say background; colours in [0, 1]."""

    usual: np.ndarray  # [H, W, 3] median over time
    other: np.ndarray  # [H, W, 3] median over the frames that differ from it
    usual_frames: np.ndarray  # [H, W] number of frames that show the usual colour
    other_frames: np.ndarray  # [H, W] number of the others


def _floats(image: np.ndarray) -> np.ndarray:
    return image / np.float32(255.0)


def _looks(images: np.ndarray, background: np.ndarray) -> _Looks:
    """The looks of images [T, H, W, 3] where the masks say background [T, H, W]."""
    usual, other = np.zeros((2, *images.shape[1:]), dtype=np.float32)
    differs = np.zeros(background.shape, dtype=bool)
    for row in range(images.shape[1]):  # a row at a time: the medians' copies in floats are large
        values = np.where(background[:, row, :, None], _floats(images[:, row]), np.float32(np.nan))
        usual[row] = median_over_time(values)
        differs[:, row] = (np.abs(values - usual[row]) > _THRESHOLD).any(axis=-1)
        other[row] = median_over_time(np.where(differs[:, row, :, None], values, np.float32(np.nan)))
    other_frames = differs.sum(axis=0)
    return _Looks(usual, other, background.sum(axis=0) - other_frames, other_frames)


class _Chosen(NamedTuple):
    """Each pixel's looks by what they are taken for."""

    still: np.ndarray  # [H, W, 3] the background's colour
    moving: np.ndarray  # [H, W, 3]
    still_frames: np.ndarray  # [H, W]
    moving_frames: np.ndarray  # [H, W]


def _chosen(looks: _Looks, swapped: np.ndarray) -> _Chosen:
    """The usual look is the background's but where `swapped` [H, W]."""
    usual, other, usual_frames, other_frames = looks
    still, moving = np.where(swapped[..., None], (other, usual), (usual, other))
    frames = np.where(swapped, (other_frames, usual_frames), (usual_frames, other_frames))
    return _Chosen(still, moving, *frames)


def _still_background(looks: _Looks, always: np.ndarray) -> _Still:
    """The background: of each pixel's two looks the one that is less like an occluder.

    An occluder that moves has the same colours in many places, the background each of its colours in its own.
    So colours are counted, for occluders at first in the rarer looks and for the background in the usual
    ones; contested pixels then choose, and colours are counted again. In the end pixels where arms may
    `always` [H, W] be choose neither, if the better look is more like an occluder, too.
    """
    usual, other, usual_frames, other_frames = looks
    contested = other_frames > _CONTESTED_SHARE * (usual_frames + other_frames)
    swapped = np.zeros(contested.shape, dtype=bool)
    area = smoothed(contested.astype(np.float64))
    # What is seen more often is more likely the background.
    odds = np.log((usual_frames + 1) / (other_frames + 1))
    for _ in range(_ROUNDS if contested.any() else 0):
        chosen = _chosen(looks, swapped)
        of_background = color_counts(chosen.still, chosen.still_frames)
        of_occluders = _of_occluders(chosen, contested)
        gain = odds + _log_ratio(other, of_occluders, of_background)
        gain -= _log_ratio(usual, of_occluders, of_background)
        gain = smoothed(np.where(contested, gain, 0.0)) / np.maximum(area, 1e-3)
        before, swapped = swapped, contested & (gain < 0.0)
        if (swapped == before).all():
            break
    chosen = _chosen(looks, swapped)
    return _without_hidden(chosen, _of_occluders(chosen, contested), always)


def _of_occluders(chosen: _Chosen, contested: np.ndarray) -> np.ndarray:
    """How often colours were seen of occluders, where pixels show two looks."""
    return color_counts(chosen.moving, np.where(contested, chosen.moving_frames, 0))


def _without_hidden(chosen: _Chosen, of_occluders: np.ndarray, always: np.ndarray) -> _Still:
    """The background, and where among `always` [H, W] what looks most like it is an occluder all the same.

    There its colours are more frequent among occluders than elsewhere in the background.
    """
    still, frames = chosen.still, chosen.still_frames
    hidden = np.zeros(always.shape, dtype=bool)
    for _ in range(_ROUNDS):
        of_hidden = color_counts(still, np.where(hidden, frames, 0))
        of_background = color_counts(still, np.where(hidden, 0, frames))
        odds = np.log1p(of_occluders + of_hidden) - np.log1p(of_background)
        gain = np.where(frames > 0, odds[color_cells(still)], 0.0)
        before, hidden = hidden, always & (smoothed(gain) > 0.0)
        if (hidden == before).all():
            break
    return _Still(still, hidden, odds)


def _log_ratio(colors: np.ndarray, counts: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Logarithm [H, W] of how much more often colours [H, W, 3] were counted than in the other histogram."""
    cells = color_cells(colors)
    return np.log1p(counts[cells]) - np.log1p(others[cells])

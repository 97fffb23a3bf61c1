"""Clips as careless capture leaves them: worse masks, pictures, poses and camera."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.ndimage
from PIL import Image
from scipy.spatial.transform import Rotation

from bigs.commands.clips.convert import write_build_clip
from bigs.data.base import Clip, HandTrack, ObjectTrack
from bigs.data.focal import with_focal_factor
from bigs.hand import HandModel
from bigs.types import MASK_VALUES, Side

# Errors of an outline are correlated over about this many pixels.
_OUTLINE_CELL = 24
# Range of a stray blob's radius, pixels.
_BLOB_RADII = (4.0, 10.0)
# A gross error turns by this many degrees and shifts by this many metres.
_GROSS_TURN = (30.0, 90.0)
_GROSS_SHIFT = (0.04, 0.12)


@dataclass(frozen=True)
class ClipDamage:
    """What is wrong with a clip; zeros leave it as it is. Shares are of the frames."""

    what: str  # short description
    outline: float = 0.0  # largest shift of outlines in or out, pixels
    blobs: int = 0  # stray discs at each subject's outline, added or cut out
    maskless: float = 0.0  # share of frames without any mask
    swapped: float = 0.0  # share of frames in which right and left swap labels
    noise: float = 0.0  # standard deviation, grey levels
    jpeg: int = 0  # quality; 0 for none
    exposure: float = 0.0  # variation of the gain about 1
    outliers: float = 0.0  # share of frames with a grossly wrong estimate, drawn for each subject
    focal: float = 1.0  # factor on the stated focal length
    brightness: float = 1.0  # factor on the pictures


DAMAGES: dict[str, ClipDamage] = {
    "outlines": ClipDamage("outlines up to 3 pixels in or out", outline=3.0),
    "blobs": ClipDamage("two blobs at each outline, added or cut out", blobs=2),
    "maskless": ClipDamage("no masks in 6 % of the frames", maskless=0.06),
    "swapped": ClipDamage("hands' labels swapped in 6 % of the frames", swapped=0.06),
    "noise": ClipDamage("sensor noise of 6 grey levels", noise=6.0),
    "jpeg": ClipDamage("pictures compressed as JPEG, quality 60", jpeg=60),
    "exposure": ClipDamage("exposure that wavers by 20 %", exposure=0.2),
    "poses": ClipDamage("poses grossly wrong in 12 % of the frames", outliers=0.12),
    "focal": ClipDamage("focal length 6 % too long, and depths with it", focal=1.06),
}
DAMAGES["together"] = ClipDamage(
    "all of these together",
    outline=3.0,
    blobs=2,
    maskless=0.06,
    swapped=0.06,
    noise=6.0,
    jpeg=60,
    exposure=0.2,
    outliers=0.12,
    focal=1.06,
)
# Careful capture in bad light.
DAMAGES["dark"] = ClipDamage("pictures 0.3 times as bright", brightness=0.3)


def write_damaged(
    folder: Path, clip: Clip, hand_models: Mapping[Side, HandModel], damage: ClipDamage, seed: int = 0
) -> Path:
    """Write a damaged clip as a build folder below `folder`.

    What is drawn for pictures, for masks and for poses is a function of the seed alone, so that damages that
    come together are those that come alone.

    Args:
        folder: where to; files of an earlier call are overwritten.
        clip: with estimates and masks.
        hand_models: those of its estimates.
        damage: what is to be wrong.
        seed: of all that is drawn.
    """
    poses, pictures, labels = (np.random.default_rng([seed, part]) for part in range(3))
    count = len(clip)
    worse = _with_outliers(clip, damage.outliers, poses)
    # What estimators tell that were told a longer focal length.
    wrists = {side: hand_models[side].rest_wrist(track.betas) for side, track in clip.hands.items()}
    worse = _dimmed(with_focal_factor(worse, wrists, damage.focal), damage.brightness)
    without, swapped = (_some(count, share, labels) for share in (damage.maskless, damage.swapped))
    gains = damage.brightness * _wavering(count, damage.exposure, pictures)

    def images() -> Iterator[np.ndarray]:
        for t in range(count):
            picture = gains[t] * clip.image(t) + damage.noise * pictures.standard_normal(
                (clip.height, clip.width, 3)
            )
            found = picture.round().clip(0, 255).astype(np.uint8)
            yield as_jpeg(found, damage.jpeg) if damage.jpeg else found

    def masks() -> Iterator[np.ndarray]:
        for t in range(count):
            found = _damaged_labels(clip.mask(t), damage, labels)
            if swapped[t]:
                right, left = (found == MASK_VALUES[side] for side in ("right", "left"))
                found[right], found[left] = MASK_VALUES["left"], MASK_VALUES["right"]
            yield np.zeros_like(found) if without[t] else found

    return write_build_clip(worse, folder, hand_models, worse.K, images(), masks())


def _dimmed(clip: Clip, brightness: float) -> Clip:
    """The clip whose object's points have the colours that darker pictures give them."""
    track = clip.object
    if track is None or track.colors is None:
        return clip
    return replace(clip, object=replace(track, colors=brightness * track.colors))


def as_jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    """A picture [H, W, 3] uint8 after it was compressed."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, format="JPEG", quality=quality)
    return np.asarray(Image.open(file, formats=["JPEG"]))


def _some(count: int, share: float, rng: np.random.Generator) -> np.ndarray:
    """So many of `count` frames, rounded up: bool [T]. Draws the same whatever the share."""
    order = rng.permutation(count)
    return order < np.ceil(share * count)


def _wavering(count: int, amount: float, rng: np.random.Generator) -> np.ndarray:
    """Gains [T] about 1: slow swings, and a quarter as much from frame to frame."""
    slow = np.sin(2.0 * np.pi * (np.arange(count) / 25.0 + rng.random()))
    return 1.0 + amount * (0.8 * slow + 0.2 * rng.uniform(-1.0, 1.0, count))


def _damaged_labels(labels: np.ndarray, damage: ClipDamage, rng: np.random.Generator) -> np.ndarray:
    """A mask [H, W] with outlines moved and blobs at them; the subject that reaches deepest has a pixel."""
    if damage.outline == 0.0 and damage.blobs == 0:
        return labels.copy()
    deepest = np.zeros(labels.shape)
    found = np.zeros_like(labels)
    for value in MASK_VALUES.values():
        inside = labels == value
        if not inside.any():
            continue
        depth = scipy.ndimage.distance_transform_edt(inside) - scipy.ndimage.distance_transform_edt(~inside)
        depth += damage.outline * _smooth_field(labels.shape, rng)
        for _ in range(damage.blobs):
            depth = _with_blob(depth, rng)
        claims = depth > deepest
        deepest[claims], found[claims] = depth[claims], value
    return found


def _smooth_field(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Values in [-1, 1] that change over about `_OUTLINE_CELL` pixels."""
    cells = [length // _OUTLINE_CELL + 2 for length in shape]
    coarse = rng.uniform(-1.0, 1.0, cells)
    rows, columns = (np.arange(length) / _OUTLINE_CELL for length in shape)
    grid = np.meshgrid(rows, columns, indexing="ij")
    return scipy.ndimage.map_coordinates(coarse, grid, order=1)


def _with_blob(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A signed depth [H, W] to which a disc at the outline is added, or from which it is cut."""
    radius, adds, at = rng.uniform(*_BLOB_RADII), rng.random() < 0.5, rng.random()
    border = np.argwhere(np.abs(depth) <= 1.0)
    if len(border) == 0:
        return depth
    row, column = border[int(at * len(border))]
    rows, columns = np.ogrid[: depth.shape[0], : depth.shape[1]]
    disc = radius - np.hypot(rows - row, columns - column)
    return np.maximum(depth, disc) if adds else np.minimum(depth, -disc)


def _with_outliers(clip: Clip, share: float, rng: np.random.Generator) -> Clip:
    """The clip with gross errors in a share of the frames; missing estimates stay missing."""

    def turned_hand(side: Side, track: HandTrack) -> HandTrack:
        hit, turns, shifts = _gross(len(clip), share, rng)
        orient = turns * Rotation.from_rotvec(track.global_orient)
        return replace(
            track,
            global_orient=np.where(hit[:, None], orient.as_rotvec(), track.global_orient),
            transl=track.transl + hit[:, None] * shifts,
        )

    def turned_object(track: ObjectTrack) -> ObjectTrack:
        hit, turns, shifts = _gross(len(clip), share, rng)
        middle = track.middle()
        rotations = np.where(hit[:, None, None], turns.as_matrix() @ track.rotations, track.rotations)
        # About its own middle, so that a wrong estimate stays where the mask is.
        transl = track.transl + (track.rotations - rotations) @ middle + hit[:, None] * shifts
        return replace(track, rotations=rotations, transl=transl)

    hands = {side: turned_hand(side, track) for side, track in clip.hands.items()}
    return replace(clip, hands=hands, object=None if clip.object is None else turned_object(clip.object))


def _gross(count: int, share: float, rng: np.random.Generator) -> tuple[np.ndarray, Rotation, np.ndarray]:
    """Which frames are hit [T], and the turns and shifts [T, 3] there."""
    hit = _some(count, share, rng)
    axes = rng.standard_normal((count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turns = Rotation.from_rotvec(np.radians(rng.uniform(*_GROSS_TURN, count))[:, None] * axes)
    ways = rng.standard_normal((count, 3))
    shifts = rng.uniform(*_GROSS_SHIFT, count)[:, None] * ways / np.linalg.norm(ways, axis=1, keepdims=True)
    return hit, turns, shifts

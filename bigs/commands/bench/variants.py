"""Variants of a clip with ground truth that are harder to preprocess."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
from PIL import Image

from bigs.commands.bench.clip_damage import as_jpeg
from bigs.data.base import Clip
from bigs.data.excerpt import excerpt_trajectory, to_and_fro
from bigs.data.limited_view import limited_frames, object_directions
from bigs.types import MASK_VALUES, SIDES, HandObjectTrajectory, Side

# Standard deviation of the sensor noise that is added to changed pictures, grey levels.
_SENSOR_NOISE = 1.3


@dataclass(frozen=True)
class KeypointNoise:
    """How simulated keypoints err."""

    sigma: float = 3.0  # pixels
    outliers: float = 0.0  # share of keypoints that lie 30 pixels away on average
    dropouts: float = 0.0  # share of keypoints without confidence
    missing: float = 0.0  # share of frames without a hand
    swaps: float = 0.0  # share of frames in which right and left are swapped


@dataclass(frozen=True)
class Variant:
    """One way to make a clip harder."""

    what: str  # short description
    frames: Callable[[Clip], np.ndarray] = lambda clip: np.arange(len(clip))
    contrast: float = 1.0  # factor on the object's contrast about its mean colour
    blur: float = 0.0  # standard deviation of the blur, pixels
    jpeg: int = 0  # JPEG quality; 0 for none
    hands: tuple[Side, ...] = SIDES
    focal_known: bool = True
    keypoints: KeypointNoise = field(default_factory=KeypointNoise)
    weak: bool = False  # little texture, for which errors may be larger

    def changes_pictures(self) -> bool:
        return self.contrast != 1.0 or self.blur > 0 or self.jpeg > 0


def _with_pause(clip: Clip) -> np.ndarray:
    middle = 2 * len(clip) // 5
    return np.concatenate([np.arange(middle), np.full(12, middle), np.arange(middle, len(clip))])


def _limited(clip: Clip) -> np.ndarray:
    return limited_frames(object_directions(clip))[0]


VARIANTS: dict[str, Variant] = {
    "plain": Variant("the clip as it is"),
    "contrast-30": Variant("the object's contrast cut to 30 %", contrast=0.3, weak=True),
    "contrast-20": Variant("the object's contrast cut to 20 %", contrast=0.2, weak=True),
    "blur": Variant("pictures blurred by 1 pixel", blur=1.0, weak=True),
    "jpeg": Variant("pictures compressed as JPEG, quality 60", jpeg=60),
    "backwards": Variant("played backwards", frames=lambda clip: np.arange(len(clip))[::-1]),
    "to-and-fro": Variant(
        "the first half, then the same backwards",
        frames=lambda clip: to_and_fro(len(clip) // 2 + 1, len(clip)),
    ),
    "second": Variant("every second frame", frames=lambda clip: np.arange(0, len(clip), 2)),
    "half": Variant("the first half", frames=lambda clip: np.arange(len(clip) // 2)),
    "pause": Variant("a pause of 12 frames in which nothing moves", frames=_with_pause),
    "limited": Variant("the quarter of the frames that see the fewest sides", frames=_limited),
    "right": Variant("no mask and no keypoints of the left hand", hands=("right",)),
    "focal": Variant("focal length not known", focal_known=False),
    "keypoints": Variant(
        "keypoints of 6 pixels noise, 8 % strays, 15 % dropouts, 8 % of frames missing, 5 % swapped",
        keypoints=KeypointNoise(sigma=6.0, outliers=0.08, dropouts=0.15, missing=0.08, swaps=0.05),
    ),
}


@dataclass(frozen=True)
class Given:
    """What a user brings, and which frames of the true clip it shows."""

    pictures: Path
    masks: Path
    keypoints: Path
    frames: np.ndarray  # [T'] of the clip's frames


def write_variant(
    folder: Path, clip: Clip, truth: HandObjectTrajectory, variant: Variant, seed: int = 0
) -> Given:
    """Write a variant's pictures, masks and keypoints below `folder`.

    Args:
        folder: where to; files of an earlier call of the same variant are overwritten.
        clip: in camera space (its world is never looked at).
        truth: of all its frames.
        variant: which.
        seed: of the noise.
    """
    rng = np.random.default_rng(seed)
    frames = variant.frames(clip)
    given = Given(folder / "pictures", folder / "masks", folder / "keypoints.json", frames)
    for place in (given.pictures, given.masks):
        place.mkdir(parents=True, exist_ok=True)
    mean = _object_colour(clip) if variant.contrast != 1.0 else np.zeros(3)
    repeated = len(np.unique(frames)) < len(frames)
    for i, t in enumerate(frames):
        image, labels = clip.image(t), clip.mask(t)
        if variant.changes_pictures() or repeated:
            image = _changed(image, labels == MASK_VALUES["object"], mean, variant, rng)
        for side in SIDES:
            if side not in variant.hands:
                labels = np.where(labels == MASK_VALUES[side], 0, labels).astype(np.uint8)
        Image.fromarray(image).save(given.pictures / f"{i:04d}.png", compress_level=1)
        Image.fromarray(labels).save(given.masks / f"{i:04d}.png", compress_level=1)
    hands: dict[Side, np.ndarray] = {side: truth.joints[side][frames] for side in variant.hands}
    rows = simulated_keypoints(hands, clip.K, variant.keypoints, rng)
    given.keypoints.write_text(json.dumps({"order": "mano", "frames": rows}), encoding="utf-8")
    return given


def truth_of(truth: HandObjectTrajectory, given: Given) -> HandObjectTrajectory:
    """The truth of the frames that a variant shows, named as its pictures are."""
    names = tuple(f"{i:04d}" for i in range(len(given.frames)))
    return replace(excerpt_trajectory(truth, given.frames), frame_names=names)


def simulated_keypoints(
    joints: Mapping[Side, np.ndarray], K: np.ndarray, noise: KeypointNoise, rng: np.random.Generator
) -> list[dict[str, Any]]:
    """True joints [T, 21, 3] of each hand as a detector would report them: the rows of the JSON file."""
    frames = len(next(iter(joints.values())))
    rows: list[dict[str, Any]] = []
    for t in range(frames):
        row: dict[str, Any] = {}
        for side, points in joints.items():
            if rng.random() < noise.missing:
                row[side] = None
                continue
            pixels = points[t] @ K.T
            found = pixels[:, :2] / pixels[:, 2:] + noise.sigma * rng.standard_normal((21, 2))
            away = rng.random(21) < noise.outliers
            found[away] += 24.0 * rng.standard_normal((int(away.sum()), 2))
            sure = np.where(rng.random(21) < noise.dropouts, 0.0, 0.9)
            row[side] = np.column_stack([found, sure]).round(2).tolist()
        if len(row) == len(SIDES) and rng.random() < noise.swaps:
            row = {"right": row["left"], "left": row["right"]}
        rows.append(row)
    return rows


def _object_colour(clip: Clip) -> np.ndarray:
    """The object's mean colour [3] over the clip."""
    total, count = np.zeros(3), 0
    for t in range(len(clip)):
        pixels = clip.image(t)[clip.mask(t) == MASK_VALUES["object"]]
        total, count = total + pixels.sum(0), count + len(pixels)
    return total / max(count, 1)


def _changed(
    image: np.ndarray, on_object: np.ndarray, mean: np.ndarray, variant: Variant, rng: np.random.Generator
) -> np.ndarray:
    found = image.astype(np.float64)
    found[on_object] = mean + variant.contrast * (found[on_object] - mean)
    if variant.blur > 0:
        found = scipy.ndimage.gaussian_filter(found, (variant.blur, variant.blur, 0))
    found += _SENSOR_NOISE * rng.standard_normal(found.shape)
    image = found.round().clip(0, 255).astype(np.uint8)
    return as_jpeg(image, variant.jpeg) if variant.jpeg else image

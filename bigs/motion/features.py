"""SIFT features on the object's pixels, through pycolmap."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from bigs.colmap import pycolmap
from bigs.threads import side_by_side, thread_count

# Margin of a crop in pixels, so that features at the object's border have their full patch.
_MARGIN = 12


@dataclass(frozen=True)
class FeatureConfig:
    """How features are found; lengths in pixels are of the clip's images."""

    # Factor by which the object's crop is enlarged before SIFT; it matters more than any other setting ...
    upscale: float = 2.0
    # -1 lets SIFT double the crop once more; 0 takes a quarter of the time and finds half as many.
    first_octave: int = -1
    # ... but not beyond this many pixels on its long side; larger crops, as from 4K video, may be reduced.
    max_side: int = 1200
    # A third of SIFT's usual contrast threshold: objects are small and evenly lit.
    peak_threshold: float = 0.002
    max_features: int = 4096


class FrameFeatures(NamedTuple):
    """Features of one frame."""

    pixels: np.ndarray  # [N, 2] column, row; the first pixel's centre is at (0.5, 0.5)
    sizes: np.ndarray  # [N] standard deviation of the blur at which it was found, pixels
    angles: np.ndarray  # [N] orientation, radians
    descriptors: np.ndarray  # [N, 128] uint8, square roots of shares with norm 512


class _Crop(NamedTuple):
    left: int
    top: int
    scale: tuple[float, float]  # enlarged pixels per pixel, horizontally and vertically


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Silence COLMAP's log in the block, except for fatal errors; failures are reported by bigs."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def extract_features(
    images: Sequence[np.ndarray], masks: np.ndarray, config: FeatureConfig
) -> list[FrameFeatures]:
    """SIFT on the pixels where `masks` is true, each frame's crop enlarged.

    Args:
        images: T arrays [H, W, 3] uint8.
        masks: [T, H, W] bool.
        config: see there.

    Returns:
        One entry per frame, without features where the mask is empty.
    """
    boxes = [crop_box(mask) for mask in masks]
    scale = enlargement(boxes, config)
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=thread_count())
    options.sift.max_num_features = config.max_features
    options.sift.peak_threshold = config.peak_threshold
    options.sift.first_octave = config.first_octave
    features = [NOTHING] * len(images)
    # pycolmap uses all cores only when it reads files.
    with tempfile.TemporaryDirectory(prefix="bigs-sift-") as folder, quiet_colmap():
        shown = {f"{t:06d}.png": (images[t], box) for t, box in enumerate(boxes) if box is not None}
        if not shown:
            return features
        written = side_by_side(lambda name: _write_crop(Path(folder) / name, *shown[name], scale), shown)
        crops = dict(zip(shown, written, strict=True))
        file = Path(folder) / "features.db"
        pycolmap.Database.open(file).close()
        pycolmap.extract_features(
            file,
            folder,
            image_names=list(crops),
            camera_mode=pycolmap.CameraMode.PER_IMAGE,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        with pycolmap.Database.open(file) as database:
            for name, crop in crops.items():
                t = int(Path(name).stem)
                stored = database.read_image_with_name(name)
                if stored is not None and database.exists_keypoints(stored.image_id):
                    features[t] = _read_features(database, stored.image_id, crop, masks[t])
    return features


NOTHING = FrameFeatures(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 128), np.uint8))


def enlargement(boxes: Sequence[tuple[int, int, int, int] | None], config: FeatureConfig) -> float:
    """The common enlargement of all crops, bounded by the largest crop."""
    largest = max((max(box[1] - box[0], box[3] - box[2]) for box in boxes if box is not None), default=1)
    return min(config.upscale, config.max_side / largest)


def crop_box(mask: np.ndarray) -> tuple[int, int, int, int] | None:
    """Top, bottom, left, right of a mask's true pixels, with a margin; None when there are none."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if rows.size == 0:
        return None
    return (
        max(int(rows[0]) - _MARGIN, 0),
        min(int(rows[-1]) + 1 + _MARGIN, mask.shape[0]),
        max(int(columns[0]) - _MARGIN, 0),
        min(int(columns[-1]) + 1 + _MARGIN, mask.shape[1]),
    )


def _write_crop(file: Path, image: np.ndarray, box: tuple[int, int, int, int], scale: float) -> _Crop:
    top, bottom, left, right = box
    crop = Image.fromarray(image[top:bottom, left:right]).convert("L")
    size = (max(round(crop.width * scale), 16), max(round(crop.height * scale), 16))
    crop.resize(size, Image.Resampling.BICUBIC).save(file, compress_level=1)
    return _Crop(left, top, (size[0] / crop.width, size[1] / crop.height))


def _read_features(
    database: pycolmap.Database, image_id: int, crop: _Crop, mask: np.ndarray
) -> FrameFeatures:
    # Columns are x, y and the 2 x 2 matrix, row by row, that carries a unit patch to the image.
    keypoints = database.read_keypoints(image_id)
    pixels = keypoints[:, :2].astype(np.float64) / crop.scale + (crop.left, crop.top)
    column, row = np.floor(pixels).astype(int).T
    inside = mask[row.clip(0, mask.shape[0] - 1), column.clip(0, mask.shape[1] - 1)]
    return FrameFeatures(
        pixels[inside],
        np.hypot(keypoints[inside, 2], keypoints[inside, 4]) / crop.scale[0],
        np.arctan2(keypoints[inside, 4], keypoints[inside, 2]),
        database.read_descriptors(image_id).data[inside],
    )

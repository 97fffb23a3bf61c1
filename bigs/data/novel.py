"""Held-back views of a clip: pictures from other cameras at some of its times, for scoring only."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from bigs.archives import read_npz
from bigs.checks import InputError
from bigs.data.entries import array_entry, require
from bigs.data.images import IMAGE_SUFFIXES, MASK_SUFFIXES, check_pairs, list_frames, read_image, read_mask

CAMERAS = "cameras.npz"


class NovelView(NamedTuple):
    """One picture from a camera that the reconstruction never saw."""

    frame_index: int  # time of the clip
    viewmat: np.ndarray  # [4, 4] the clip's camera frame of that time -> this camera, OpenCV axes
    K: np.ndarray  # [3, 3]
    image_path: Path
    mask_path: Path
    size: tuple[int, int]  # width, height

    def image(self) -> np.ndarray:
        """[H, W, 3] uint8."""
        return read_image(self.image_path, self.size)

    def mask(self) -> np.ndarray:
        """Labels [H, W] uint8, as a clip's."""
        return read_mask(self.mask_path, self.size)


def load_novel_views(folder: str | Path, frame_count: int) -> list[NovelView]:
    """The views of a folder with image/, mask/ and cameras.npz (K, R, t, frame, wh).

    Args:
        folder: usually CLIP/novel.
        frame_count: how many frames the clip has.

    Raises:
        InputError: something is missing, damaged or does not fit, or a view is of a time beyond the clip.
    """
    folder = Path(folder)
    file = folder / CAMERAS
    arrays = read_npz(file, "the cameras of held-out views")
    image_paths = list_frames(folder / "image", IMAGE_SUFFIXES)
    mask_paths = list_frames(folder / "mask", MASK_SUFFIXES)
    check_pairs(image_paths, mask_paths)
    views = len(image_paths)

    def field(key: str, shape: tuple[int | str, ...]) -> np.ndarray:
        return array_entry(f"{file}: {key}", require(f"{file}: {key}", arrays, key), shape)

    frames = field("frame", (views,)).astype(int)
    if frames.min() < 0 or frames.max() >= frame_count:
        raise InputError(
            f"{file}: frame: expected times from 0 to {frame_count - 1}, "
            f"found {frames.min()} to {frames.max()}"
        )
    viewmats = np.repeat(np.eye(4)[None], views, axis=0)
    viewmats[:, :3, :3] = field("R", (views, 3, 3))
    viewmats[:, :3, 3] = field("t", (views, 3))
    Ks = field("K", (views, 3, 3))
    width, height = field("wh", (2,)).astype(int)
    return [
        NovelView(
            int(frames[v]), viewmats[v], Ks[v], image_paths[v], mask_paths[v], (int(width), int(height))
        )
        for v in range(views)
    ]

"""Decoded frame files, which every part of a run looks at again."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Lock
from typing import NamedTuple

import numpy as np

from bigs.data.images import read_image, read_mask
from bigs.threads import side_by_side
from bigs.types import ENTITIES, MASK_VALUES, Entity

# Bytes that are kept: 60 frames of 800 x 600 with their masks.
_MOST = 128 * 2**20

# Reads a file of a size (width, height).
_Reader = Callable[[Path, tuple[int, int]], np.ndarray]


class _Asked(NamedTuple):
    """What was asked of a file, and the file as it was then."""

    reader: _Reader
    path: Path
    size: tuple[int, int]
    changed: int  # ns
    bytes: int


class DecodedFrames:
    """Reads frames and keeps what it decoded, until it holds `most` bytes; files may change meanwhile.

    What comes first stays: a clip that does not fit is read in turn, and of what was used last nothing would
    be left when it is wanted again. Any number of threads may read.
    """

    def __init__(self, most: int = _MOST) -> None:
        self._room = most
        self._kept: dict[_Asked, np.ndarray] = {}
        self._lock = Lock()

    def image(self, path: Path, size: tuple[int, int]) -> np.ndarray:
        """As `read_image`; an array of the caller's own."""
        return self._read(read_image, path, size)

    def mask(self, path: Path, size: tuple[int, int]) -> np.ndarray:
        """As `read_mask`; an array of the caller's own."""
        return self._read(read_mask, path, size)

    def read_all(
        self, image_paths: Sequence[Path], mask_paths: Sequence[Path], size: tuple[int, int]
    ) -> dict[Entity, np.ndarray]:
        """Decode everything once, as a check, and count each entity's mask pixels: {entity: [T]}.

        Args:
            image_paths: T images, or none to be checked.
            mask_paths: T label masks, or none, and every count is 0.
            size: (width, height) that each file must have.

        Raises:
            InputError: a file is unreadable or has another size.
        """

        def check(image: Path) -> None:
            self.image(image, size)

        def areas(mask: Path) -> list[int]:
            counts = np.bincount(self.mask(mask, size).ravel(), minlength=256)
            return [int(counts[MASK_VALUES[entity]]) for entity in ENTITIES]

        side_by_side(check, image_paths)
        counts = side_by_side(areas, mask_paths) or [[0] * len(ENTITIES)] * len(image_paths)
        table = np.array(counts)
        return {entity: table[:, column] for column, entity in enumerate(ENTITIES)}

    def _read(self, reader: _Reader, path: Path, size: tuple[int, int]) -> np.ndarray:
        try:
            now = os.stat(path)
        except OSError:
            return reader(path, size)  # which says what is wrong
        asked = _Asked(reader, path, size, now.st_mtime_ns, now.st_size)
        kept = self._kept.get(asked)
        if kept is not None:
            return kept.copy()
        pixels = reader(path, size)
        with self._lock:
            if asked not in self._kept and pixels.nbytes <= self._room:
                self._room -= pixels.nbytes
                self._kept[asked] = pixels.copy()
        return pixels

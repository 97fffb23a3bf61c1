"""A clip's targets at every size that stages ask for; the next ones are made beside the running stage."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import Future
from typing import NamedTuple

import numpy as np

from bigs.data.base import Clip
from bigs.threads import beside
from bigs.train.loop.targets import Targets, crop_box, load_targets

# Stages return to an earlier resolution; of the others this many bytes are kept, since memory is scarce.
_KEPT = 160 * 2**20


class _Ahead(NamedTuple):
    """Targets that a thread is making."""

    size: int
    made: Future[Targets]


class TargetSource:
    """Makes targets when they are asked for, or in a thread of its own before that.

    No more than one size is made ahead, so that memory holds at most that beside what is looked at and kept.
    """

    def __init__(self, clip: Clip, unknown: np.ndarray) -> None:
        """`unknown` [T, H, W] (bool) marks unlabelled occluders at the clip's size."""
        self.clip = clip
        self.unknown = unknown
        self._thread = beside()
        # Every mask is read for it.
        self._box = self._thread.submit(crop_box, clip)
        self._made: dict[int, Targets] = {}
        self._ahead: _Ahead | None = None

    def at(self, size: int) -> Targets:
        """Images and masks, shrunk as a frame to a long side of `size` pixels; 0 keeps the clip's size.

        Raises:
            InputError: a picture cannot be read.
        """
        size = self._shrunk_to(size)
        found = self._made.pop(size, None)
        # Before new ones take their room.
        self._forget(_KEPT)
        if found is None and self._ahead is not None and self._ahead.size == size:
            ahead, self._ahead = self._ahead, None
            found = ahead.made.result()
        if found is None:
            found = self._load(size)
        self._made[size] = found
        return found

    def cropped(self) -> float:
        """The share of a frame that is looked at: the box in which hands and object ever are."""
        x0, y0, x1, y1 = self._box.result()
        return (x1 - x0) * (y1 - y0) / (self.clip.width * self.clip.height)

    def make_ahead(self, sizes: Iterable[int]) -> None:
        """Begin to make the first of the sizes that `at` will be asked for and that is not there yet."""
        missing = [size for size in map(self._shrunk_to, sizes) if size not in self._made]
        if missing and (self._ahead is None or self._ahead.size != missing[0]):
            self._ahead = _Ahead(missing[0], self._thread.submit(self._load, missing[0], 1))

    def _load(self, size: int, threads: int | None = None) -> Targets:
        long_side = max(self.clip.width, self.clip.height)
        return load_targets(self.clip, self.unknown, size / long_side, self._box.result(), threads)

    def _shrunk_to(self, size: int) -> int:
        """The long side of a frame at a size; nothing is enlarged."""
        long_side = max(self.clip.width, self.clip.height)
        return min(size, long_side) if size else long_side

    def _forget(self, most: int) -> None:
        """Let go of targets until what is left has at most this many bytes, the longest unused first."""
        for size in list(self._made):
            if sum(targets.size() for targets in self._made.values()) > most:
                del self._made[size]

"""Matching of another tool's files to frames: by name, by number, or by order."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePath

from bigs.checks import InputError
from bigs.preprocess.artefacts import FrameSet


def match_names(where: str, names: Sequence[str], frames: FrameSet) -> list[int | None]:
    """For each frame the index in `names` that belongs to it, or None where a named thing is missing.

    Names are compared without folder and suffix. Where no name agrees, order counts, provided that there
    is one thing for each frame that was kept or one for each frame of the source.

    Raises:
        InputError: nothing fits.
    """
    place = {PurePath(name).stem: index for index, name in enumerate(names)}
    if len(place) == len(names):
        found = [place.get(PurePath(name).stem) for name in frames.names]
        if any(index is not None for index in found):
            return found
    return list(match_count(where, len(names), frames))


def match_count(where: str, count: int, frames: FrameSet) -> list[int]:
    """For each frame its index among `count` things in order.

    Raises:
        InputError: there is neither one for each frame nor one for each frame of the source.
    """
    kept = len(frames.names)
    if count == kept:
        return list(range(kept))
    if frames.source_length and count == frames.source_length:
        return list(frames.source_frames)
    expected = f"{kept} (one for each frame)"
    if frames.source_length and frames.source_length != kept:
        expected += f" or {frames.source_length} (one for each frame of the source)"
    raise InputError(f"{where}: expected {expected} or names like {frames.names[0]}, found {count}")

"""COLMAP's binary files, walked before its own reader, which takes what is cut off for zeros."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from bigs.checks import InputError
from bigs.files import check_regular, read_bytes

# Parameters of each camera model, by number, from COLMAP's documentation.
_PARAMS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12, 11: 16}
# A model of a thousand frames has 30 MB.
_MAX_BYTES = 1 << 30
# No file system has longer names.
_LONGEST_NAME = 4096


class _Cut(Exception):
    """The file ends before what it announces."""


class _Reader(NamedTuple):
    """Bytes, read from front to back."""

    content: bytes

    def number(self, at: int, kind: str) -> int:
        size = struct.calcsize(f"<{kind}")
        if at + size > len(self.content):
            raise _Cut
        return int(struct.unpack_from(f"<{kind}", self.content, at)[0])

    def camera(self, at: int) -> int:
        model = self.number(at + 4, "i")
        if model not in _PARAMS:
            raise InputError(f"expected a camera model from 0 to {max(_PARAMS)}, found {model}")
        return at + 24 + 8 * _PARAMS[model]

    def image(self, at: int) -> int:
        name = at + 4 + 7 * 8 + 4
        end = self.content.find(b"\0", name, name + _LONGEST_NAME)
        if end < 0:
            raise _Cut
        return end + 9 + 24 * self.number(end + 1, "Q")

    def point(self, at: int) -> int:
        track = at + 8 + 3 * 8 + 3 + 8
        return track + 8 + 8 * self.number(track, "Q")

    def rig(self, at: int) -> int:
        sensors, at = self.number(at + 4, "I"), at + 8
        # The first camera is the one that the others' poses refer to; each of the others may have a pose.
        for index in range(sensors):
            at += 8 if index == 0 else 9 + 56 * bool(self.number(at + 8, "B"))
        return at

    def frame(self, at: int) -> int:
        return at + 68 + 16 * self.number(at + 64, "I")


_ENTRIES: dict[str, Callable[[_Reader, int], int]] = {
    "cameras": _Reader.camera,
    "images": _Reader.image,
    "points3D": _Reader.point,
    # Since version 3.12.
    "rigs": _Reader.rig,
    "frames": _Reader.frame,
}
_REQUIRED = ("cameras", "images", "points3D")


def check_model_files(place: Path) -> None:
    """Refuse a binary model of which a file is cut off, or goes on after its last entry.

    Raises:
        InputError: such a file, one that is no regular file, or one that is missing; a model in text has
            nothing to be walked.
    """
    for name, entry in _ENTRIES.items():
        file, text = place / f"{name}.bin", place / f"{name}.txt"
        for found in (file, text):
            if found.exists():
                check_regular(found, "a file of a COLMAP model", _MAX_BYTES)
        if not file.exists():
            if name in _REQUIRED and not text.exists():
                raise InputError(f"{file}: expected a file of a COLMAP model, found none")
            continue
        reader, at, read = _Reader(read_bytes(file, "a file of a COLMAP model")), 8, 0
        try:
            count = reader.number(0, "Q")
            while read < count:
                at = entry(reader, at)
                if at > len(reader.content):
                    raise _Cut
                read += 1
        except _Cut:
            raise InputError(
                f"{file}: expected a whole file, found that it ends within entry {read}"
            ) from None
        except InputError as error:
            raise InputError(f"{file}: entry {read}: {error}") from None
        if at != len(reader.content):
            raise InputError(
                f"{file}: expected {count} entries in {at} bytes, found {len(reader.content)} bytes"
            )

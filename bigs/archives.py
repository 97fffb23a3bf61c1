"""Archives of arrays (.npy, .npz) and zip files, whose announced sizes are checked before they are unpacked.

A few kilobytes of zip can unpack to gigabytes, and a header of 80 bytes can announce an array of terabytes.
"""

from __future__ import annotations

import io
import math
import tokenize
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from bigs.checks import ARCHIVE_ERRORS, InputError, shown
from bigs.files import MIB, open_regular

# An archive may always unpack to this many bytes, or to this many times its own size: constant tracks
# compress a hundredfold, moving ones hardly at all.
MAX_UNPACKED_BYTES = 256 * MIB
MAX_RATIO = 16
# A poses file has 30 members.
MAX_MEMBERS = 10_000

# Other compressions unpack in steps of unbounded size.
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_HEADER_ERRORS: tuple[type[Exception], ...] = (
    *ARCHIVE_ERRORS,
    SyntaxError,
    tokenize.TokenError,
    TypeError,
    MemoryError,
)
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def open_zip(where: str, stream: BinaryIO, what: str = "a zip file") -> zipfile.ZipFile:
    """Open a zip archive after checking the size of every member.

    Args:
        where: what to call it in messages, usually its path.
        stream: its bytes; stays open.
        what: what it should be, for messages.

    Raises:
        InputError: no zip file, too many members, or one that is packed in an unusual way or too well.
    """
    size = stream.seek(0, io.SEEK_END)
    stream.seek(0)
    try:
        archive = zipfile.ZipFile(stream)
    except ARCHIVE_ERRORS as error:
        raise InputError(f"{where}: expected {what}, found {str(error).lower()}") from None
    members = archive.infolist()
    if len(members) > MAX_MEMBERS:
        raise InputError(f"{where}: expected at most {MAX_MEMBERS} members, found {len(members)}")
    for member in members:
        if member.compress_type not in _METHODS:
            raise InputError(
                f"{where}: {shown(member.filename)}: expected a stored or deflated member, found compression "
                f"{member.compress_type}"
            )
    unpacked, most = sum(member.file_size for member in members), MAX_UNPACKED_BYTES + MAX_RATIO * size
    if unpacked > most:
        raise InputError(
            f"{where}: expected an archive that unpacks to at most {most} bytes, found one of {unpacked}"
        )
    return archive


def read_member(where: str, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """Read a member of an archive from `open_zip`: never more bytes than announced.

    Raises:
        InputError: it is damaged or encrypted.
    """
    try:
        # Without a size, the whole member would be unpacked before it is cut.
        with archive.open(member) as stream:
            return stream.read(member.file_size)
    except ARCHIVE_ERRORS as error:
        raise InputError(
            f"{where}: {shown(member.filename)}: expected a whole member, found a damaged one "
            f"({error or type(error).__name__})"
        ) from None


def read_npz(path: str | Path, what: str, keys: Sequence[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an .npz file.

    Args:
        path: the file.
        what: what it should be, for messages.
        keys: only these, where they are there; None is all.

    Raises:
        InputError: no such file, or it is no archive of plain arrays, or announces more than it holds.
    """
    arrays, wanted = {}, f"{what}, an .npz archive of plain arrays"
    with open_regular(path, what) as stream, open_zip(str(path), stream, wanted) as archive:
        for member in archive.infolist():
            key = member.filename.removesuffix(".npy")
            if keys is None or key in keys:
                content = io.BytesIO(read_member(str(path), archive, member))
                arrays[key] = read_array(f"{path}: {shown(key)}", content, member.file_size)
    return arrays


def read_array(where: str, stream: BinaryIO, size: int) -> np.ndarray:
    """A plain array as `np.save` writes it.

    Args:
        where: what to call it in messages.
        stream: at its beginning.
        size: how many bytes there are.

    Raises:
        InputError: no plain array, or one whose header announces another size.
    """
    start = stream.tell()
    shape, dtype = npy_header(where, stream)
    if dtype.hasobject:
        raise InputError(f"{where}: expected an archive of plain arrays, found pickled objects")
    announced, there = math.prod(shape) * dtype.itemsize, size - (stream.tell() - start)
    if announced > there:
        raise InputError(
            f"{where}: expected {announced} bytes as its header announces (shape {shown(list(shape))}), "
            f"found {there}"
        )
    stream.seek(start)
    try:
        return np.lib.format.read_array(stream, allow_pickle=False)
    except ARCHIVE_ERRORS as error:
        raise InputError(f"{where}: expected an array, found {error or type(error).__name__}") from None


def npy_header(where: str, stream: BinaryIO) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type in an .npy header; leaves `stream` at the first byte after it.

    Raises:
        InputError: no such header.
    """
    try:
        version = np.lib.format.read_magic(stream)
        if version not in _HEADERS:
            raise ValueError(f"format version {version}")
        shape, _, dtype = _HEADERS[version](stream)
    # The header is a Python literal; damage and deep nesting raise many kinds of errors.
    except _HEADER_ERRORS as error:
        reason = str(error).splitlines() or [type(error).__name__]
        raise InputError(f"{where}: expected an .npy array, found {reason[0]}") from None
    if any(length < 0 for length in shape):
        raise InputError(f"{where}: expected a shape, found {shown(list(shape))}")
    return shape, dtype

"""Open other people's files: regular ones of a bounded size.

A pipe or a device in place of a file would keep a reader waiting or reading for ever. All input is opened
here, or checked by `check_regular` before a library opens it by its path.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO

import yaml

from bigs.checks import InputError, meant, neighbour, shown

MIB = 1 << 20
# JSON keypoints of two hands in 2000 frames are 8 MB; parsed, a file takes some twenty times its size.
MAX_TEXT_BYTES = 64 * MIB
# A configuration has 10 kB, a manifest of 5000 clips 500 kB. YAML is read at about 1 MB per second.
MAX_YAML_BYTES = 2 * MIB
# Limit of a YAML document with every alias written out.
MAX_YAML_NODES = 200_000
# bigs's own JSON and YAML are five levels deep.
MAX_DEPTH = 50
# No measurement has more digits, and parsing time grows with their square.
MAX_DIGITS = 100
_TOO_LARGE = 10**MAX_DIGITS
# Arrays, videos, weights of networks.
MAX_FILE_BYTES = 64 << 30


def open_regular(path: str | Path, what: str, most: int = MAX_FILE_BYTES) -> BinaryIO:
    """A file, opened for reading in binary mode.

    Args:
        path: where it should be.
        what: what it should be, for messages, such as "a hand model".
        most: how many bytes it may have.

    Raises:
        InputError: there is no such file; it is a folder, pipe or device; it is too large or cannot be read.
    """
    try:
        # Non-blocking, since the path may be a pipe without a writer.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (OSError, ValueError) as error:  # ValueError for a path with NUL
        raise InputError(f"{path}: expected {what}, found {_no_file(error, path)}") from None
    try:
        _check(os.fstat(handle), path, what, most)
    except InputError:
        os.close(handle)
        raise
    return os.fdopen(handle, "rb")


def check_regular(path: str | Path, what: str, most: int = MAX_FILE_BYTES) -> None:
    """Check like `open_regular`, for files that a library opens by their path.

    Raises:
        InputError: as `open_regular`.
    """
    try:
        _check(os.stat(path), path, what, most)
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: expected {what}, found {_no_file(error, path)}") from None


def read_bytes(path: str | Path, what: str, most: int = MAX_FILE_BYTES) -> bytes:
    """The content of a file; raises as `open_regular`."""
    with open_regular(path, what, most) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def read_text(path: str | Path, what: str, most: int = MAX_TEXT_BYTES) -> str:
    """The content of a text file in UTF-8.

    Raises:
        InputError: as `open_regular`, or it is no such text.
    """
    try:
        return read_bytes(path, what, most).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: expected {what}, text in UTF-8, found other bytes ({error.reason} at {error.start})"
        ) from None


def read_json(path: str | Path, what: str = "a JSON file") -> Any:
    """Read a JSON file.

    Raises:
        InputError: as `read_text`, or no JSON, nested deeper than `MAX_DEPTH`, or with absurd numbers.
    """
    return parse_json(str(path), read_text(path, what))


def read_yaml(path: str | Path, what: str = "a YAML file") -> Any:
    """Read a YAML file: plain data with a bounded number of aliases.

    Raises:
        InputError: as `read_text` and `parse_yaml`.
    """
    return parse_yaml(str(path), read_text(path, what, MAX_YAML_BYTES))


def parse_json(where: str, text: str) -> Any:
    """JSON in a text; raises as `read_json`."""
    try:
        document = json.loads(text)
    except RecursionError:
        raise InputError(f"{where}: expected JSON of at most {MAX_DEPTH} levels, found more") from None
    except ValueError as error:  # a JSONDecodeError, or a number with thousands of digits
        raise InputError(f"{where}: expected JSON, found {error}") from None
    _check_values(where, document)
    return document


def parse_yaml(where: str, text: str) -> Any:
    """YAML in a text: plain data only, never Python objects.

    Raises:
        InputError: no YAML; nested deeper than `MAX_DEPTH`; with more than `MAX_YAML_NODES` once its aliases
            are written out; or with absurd numbers.
    """
    try:
        _check_yaml(where, text)
        document = yaml.load(text, Loader=_YamlLoader)
    except yaml.YAMLError as error:
        raise InputError(f"{where}: expected YAML, found {' '.join(str(error).split())}") from None
    except (ValueError, OverflowError, TypeError, RecursionError) as error:
        # Values that look like dates or numbers but are none, and keys that are lists.
        if isinstance(error, InputError):
            raise
        raise InputError(f"{where}: expected YAML, found {shown(str(error))}") from None
    _check_values(where, document)
    return document


# The C loader is ten times as fast, where PyYAML has it.
_YamlLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _check_yaml(where: str, text: str) -> None:
    """Count what a document would unfold to by walking over its events, which takes no memory."""
    sizes: dict[str, int] = {}  # number of nodes that each anchor stands for
    open_nodes: list[tuple[str | None, int]] = []  # anchor, and nodes counted before it began
    count = 0
    for event in yaml.parse(text, Loader=_YamlLoader):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise InputError(f"{where}: expected aliases after their anchors, found *{event.anchor}")
            count += sizes[event.anchor]
        elif isinstance(event, yaml.ScalarEvent):
            count += 1
            if event.anchor is not None:
                sizes[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, count))
            count += 1
            if len(open_nodes) > MAX_DEPTH:
                raise InputError(f"{where}: expected YAML of at most {MAX_DEPTH} levels, found more")
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_nodes.pop()
            if anchor is not None:
                sizes[anchor] = count - before
        if count > MAX_YAML_NODES:
            raise InputError(
                f"{where}: expected YAML of at most {MAX_YAML_NODES} values with its aliases written out, "
                "found more"
            )


def _check_values(where: str, document: Any) -> None:
    """Refuse deep nesting and absurd numbers, level by level since recursion has its own limit."""
    level, depth = [document], 0
    while level:
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                below += value
                below += value.values()
            elif isinstance(value, list | tuple | set):
                below += value
            elif isinstance(value, int) and abs(value) >= _TOO_LARGE:
                raise InputError(
                    f"{where}: expected numbers of at most {MAX_DIGITS} digits, found {shown(value)}"
                )
        level, depth = below, depth + 1
        if depth > MAX_DEPTH:
            raise InputError(f"{where}: expected at most {MAX_DEPTH} levels, found more")


def _check(found: os.stat_result, path: str | Path, what: str, most: int) -> None:
    if not stat.S_ISREG(found.st_mode):
        kinds = {
            stat.S_IFDIR: "a folder",
            stat.S_IFIFO: "a pipe",
            stat.S_IFCHR: "a device",
            stat.S_IFBLK: "a device",
            stat.S_IFSOCK: "a socket",
        }
        kind = kinds.get(stat.S_IFMT(found.st_mode), "no regular file")
        raise InputError(f"{path}: expected {what}, found {kind}")
    if found.st_size > most:
        raise InputError(f"{path}: expected {what} of at most {most} bytes, found {found.st_size}")


def _no_file(error: OSError | ValueError, path: str | Path) -> str:
    number = error.errno if isinstance(error, OSError) else None
    if number in (errno.ENOENT, errno.ENOTDIR) or number is None:
        return f"no such file{meant(neighbour(path))}"
    # Windows reports this for folders, Linux for sockets.
    if number in (errno.EACCES, errno.ENXIO) and not os.path.isfile(path):
        return "no regular file"
    return f"one that cannot be opened ({os.strerror(number)})"

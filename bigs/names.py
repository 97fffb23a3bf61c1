"""Names from a file that become file names: one plain component each, on any system."""

from __future__ import annotations

import re
import unicodedata
from pathlib import Path
from typing import Any

from bigs.checks import InputError, shown

# File systems allow 255 bytes, and suffixes (".safetensors", temporary files) must fit too.
MAX_NAME_BYTES = 200
# Of a whole path; systems allow 4096 bytes.
_MAX_PATH_BYTES = 4000
_MAX_PART_BYTES = 255
# Windows has devices of these names in every folder, with any suffix.
_DEVICES = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|clock\$|(com|lpt)[0-9¹²³])", re.IGNORECASE)


def check_name(where: str, name: Any) -> str:
    """Return `name` if it is a plain file name on any system.

    Args:
        where: file and field, for the message.
        name: what the file says.

    Raises:
        InputError: no text, empty, a separator, `.` or `..`, control characters, not Unicode, a device of
            Windows, a dot or a blank at the end, or too long.
    """
    reason = _text_reason(name) or _component_reason(name)
    if reason:
        raise InputError(f"{where}: expected a plain name, found {shown(name)} ({reason})")
    return str(name)


def check_path(where: str, path: Any) -> str:
    """Return `path` if it can be opened: text without control characters, with parts of legal length.

    Unlike a name it may lead anywhere; use it for input that the user chooses.

    Raises:
        InputError: it cannot.
    """
    reason = _text_reason(path)
    if not reason:
        parts = [len(part.encode()) for part in str(path).split("/")]
        if max(parts) > _MAX_PART_BYTES or sum(parts) + len(parts) > _MAX_PATH_BYTES:
            reason = "too long"
    if reason:
        raise InputError(f"{where}: expected a path, found {shown(path)} ({reason})")
    return str(path)


def check_inside(where: str, path: Any) -> Path:
    """Return `path` if it stays below its folder: plain names with `/` between them.

    Raises:
        InputError: it leads elsewhere, or a part is no plain name.
    """
    parts = check_path(where, path).removeprefix("./").split("/")
    for part in parts:
        reason = _component_reason(part)
        if reason:
            raise InputError(
                f"{where}: expected a file in the same folder or below it, found {shown(path)} ({reason})"
            )
    return Path(*parts)


def _text_reason(text: Any) -> str:
    """Why a file system would refuse a value as text; empty if it would not."""
    if not isinstance(text, str):
        return f"{type(text).__name__}, not text"
    if not text:
        return "empty"
    # A long text is cut; the message states its length anyway.
    if any(unicodedata.category(letter) in ("Cc", "Zl", "Zp") for letter in text[: 4 * _MAX_PATH_BYTES]):
        return "a control character"
    try:
        text.encode()
    except UnicodeEncodeError:
        return "not Unicode text"
    return "too long" if len(text) > _MAX_PATH_BYTES else ""


def _component_reason(name: str) -> str:
    if "/" in name or "\\" in name or ":" in name:
        return "a path"
    if name in ("", ".", ".."):
        return "another folder"
    if name[-1] in ". ":
        return "a dot or a blank at the end"
    if _DEVICES.fullmatch(name.split(".")[0].rstrip(" ")):
        return "a device's name on Windows"
    size = len(name.encode())
    return f"{size} bytes, more than {MAX_NAME_BYTES}" if size > MAX_NAME_BYTES else ""

"""Checks at the border: one sentence that names the field, what was expected and what was found."""

from __future__ import annotations

import math
import reprlib
import zipfile
import zlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch

# What numpy and zipfile raise of an archive that is damaged (a flipped bit may look like any), encrypted or
# of an unknown compression (both RuntimeError).
ARCHIVE_ERRORS: tuple[type[Exception], ...] = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    AttributeError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)


# Of a picture: twice as many as 8K video has. One takes 200 MB as bytes of three colours.
MAX_PIXELS = 1 << 26
# Rotations are kept in float32 and in print with six digits.
ROTATION_TOLERANCE = 1e-3
# How much of a value from a file a message shows.
_SHOWN = 80
_BRIEFLY = reprlib.Repr()
_BRIEFLY.maxlevel, _BRIEFLY.maxstring, _BRIEFLY.maxother, _BRIEFLY.maxlong = 3, _SHOWN, _SHOWN, _SHOWN


class InputError(ValueError):
    """Something the user gave is wrong. The message is one sentence for the user; no traceback is needed."""


def check_shape(name: str, array: Any, shape: Sequence[int | str | None]) -> None:
    """Raise `InputError` unless `array.shape` matches `shape`.

    Args:
        name: what to call the array in the message; include the file when there is one.
        array: anything with a `shape`.
        shape: one entry per axis: an int must match, a string or None matches any length and is shown.
    """
    found = tuple(array.shape)
    matches = len(found) == len(shape) and all(
        not isinstance(want, int) or want == have for want, have in zip(shape, found, strict=True)
    )
    if not matches:
        expected = ", ".join("any" if want is None else str(want) for want in shape)
        raise InputError(f"{name}: expected shape [{expected}], found {list(found)}")


def check_finite(name: str, array: Any) -> None:
    """Raise `InputError` naming the first index at which `array` (numpy or torch) is not finite."""
    values = array.detach().cpu().numpy() if isinstance(array, torch.Tensor) else np.asarray(array)
    finite = np.isfinite(values)
    if not finite.all():
        index = tuple(int(i) for i in np.argwhere(~finite)[0])
        raise InputError(f"{name}: expected finite values, found {values[index]} at index {list(index)}")


def check_rotations(name: str, matrices: Any) -> None:
    """Raise `InputError` naming the first of `matrices` [..., 3, 3] that is no rotation."""
    values = np.asarray(matrices, dtype=np.float64)
    check_finite(name, values)
    error = np.abs(values @ np.swapaxes(values, -1, -2) - np.eye(3)).max(axis=(-1, -2), initial=0.0)
    wrong = (error > ROTATION_TOLERANCE) | (np.linalg.det(values) < 0.0)
    if wrong.any():
        index = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise InputError(
            f"{name}: expected a rotation (determinant +1), found {shown(values[index].tolist())}"
            f" at index {list(index)}"
        )


def check_faces(name: str, faces: Any, vertex_count: int) -> None:
    """Raise `InputError` unless `faces` [F, 3] are whole numbers that count `vertex_count` vertices."""
    values = faces.detach().cpu().numpy() if isinstance(faces, torch.Tensor) else np.asarray(faces)
    check_shape(name, values, ("F", 3))
    if values.dtype.kind not in "iu" and not (values == np.floor(values)).all():
        raise InputError(f"{name}: expected whole numbers, found {values.dtype}")
    if values.size and (values.min() < 0 or values.max() >= vertex_count):
        raise InputError(
            f"{name}: expected indices from 0 to {vertex_count - 1}, found {values.min():g} to "
            f"{values.max():g}"
        )


def check_pixels(name: str, width: int, height: int, most: int = MAX_PIXELS) -> None:
    """Raise `InputError` unless a picture of `width` x `height` has at most `most` pixels."""
    if width * height > most:
        raise InputError(f"{name}: expected at most {most} pixels, found {width} x {height}")


def check_choice(name: str, value: Any, choices: Iterable[Any]) -> None:
    """Raise `InputError` unless `value` is one of `choices`."""
    accepted = list(choices)
    if value not in accepted:
        raise InputError(f"{name}: expected one of {', '.join(map(str, accepted))}, found {shown(value)}")


def shown(value: Any) -> str:
    """Somebody else's value for a message: one line, short, and without an exception whatever it is.

    Python itself refuses to print integers of more than 4300 digits, and runs out of stack where lists are
    nested deeply.
    """
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 4 * _SHOWN:
        return f"an integer of about {math.ceil(value.bit_length() * math.log10(2))} digits"
    if isinstance(value, np.ndarray | torch.Tensor) and math.prod(value.shape) > 16:
        return f"an array of shape {list(value.shape)}"
    try:
        text = " ".join(_BRIEFLY.repr(value).split())
    except Exception:  # a value may raise whatever it likes
        return f"a {type(value).__name__} that cannot be shown"
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."

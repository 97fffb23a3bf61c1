"""Checks at the border: one sentence that names the field, what was expected and what was found."""

from __future__ import annotations

import difflib
import math
import reprlib
import zipfile
import zlib
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

# What numpy and zipfile raise for an archive that is damaged, encrypted or of an unknown compression.
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


# Limit of a picture: twice 8K video, or 200 MB as bytes of three colours.
MAX_PIXELS = 1 << 26
# Limit of a mesh over all frames: 1200 frames (ARCTIC's longest sequence) of 80 000 vertices, 2.4 GB in
# double precision.
MAX_MOVED_VERTICES = 100_000_000
# Rotations are stored as float32 and printed with six digits.
ROTATION_TOLERANCE = 1e-3
# Messages show this much of a value from a file.
_SHOWN = 80
_BRIEFLY = reprlib.Repr()
_BRIEFLY.maxlevel, _BRIEFLY.maxstring, _BRIEFLY.maxother, _BRIEFLY.maxlong = 3, _SHOWN, _SHOWN, _SHOWN
# Longer lists of accepted names are left out of a message if one of them is close.
_MOST_RECITED = 12
# Similarity of two names, 0 to 1, from which one is suggested for the other.
_ALIKE = 0.6
# In larger folders not every file is compared with a missing one.
_MOST_NEIGHBOURS = 1000


class InputError(ValueError):
    """The user's input is wrong. The message is one sentence; no traceback is needed."""


def check_shape(name: str, array: Any, shape: Sequence[int | str | None]) -> None:
    """Raise `InputError` unless `array.shape` matches `shape`.

    Args:
        name: what to call the array in the message; include the file when there is one.
        array: anything with a `shape`.
        shape: one entry per axis: an int must match, a string or None matches any length and is shown. "..."
            as the first entry stands for any number of axes.
    """
    if not hasattr(array, "shape"):
        raise InputError(f"{name}: expected an array, found {type(array).__name__}")
    found = tuple(array.shape)
    last = tuple(shape[1:] if shape and shape[0] == "..." else shape)
    compared = found[max(0, len(found) - len(last)) :] if len(last) < len(shape) else found
    matches = len(compared) == len(last) and all(
        not isinstance(want, int) or want == have for want, have in zip(last, compared, strict=True)
    )
    if not matches:
        expected = ", ".join("any" if want is None else str(want) for want in shape)
        raise InputError(f"{name}: expected shape [{expected}], found {list(found)}")


def _is_tensor(value: Any) -> bool:
    # By name: to load torch takes longer than all that `bigs --help` does.
    return any(f"{kind.__module__}.{kind.__name__}" == "torch.Tensor" for kind in type(value).__mro__)


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray) or _is_tensor(value)


def _as_numpy(array: Any) -> np.ndarray:
    return np.asarray(array.detach().cpu() if _is_tensor(array) else array)


def check_finite(name: str, array: Any) -> None:
    """Raise `InputError` naming the first index at which `array` (numpy or torch) is not finite."""
    values = _as_numpy(array)
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
    values = _as_numpy(faces)
    check_shape(name, values, ("F", 3))
    if values.dtype.kind not in "iu" and not (values == np.floor(values)).all():
        raise InputError(f"{name}: expected whole numbers, found {values.dtype}")
    if values.size and (values.min() < 0 or values.max() >= vertex_count):
        raise InputError(
            f"{name}: expected indices from 0 to {vertex_count - 1}, found {values.min():g} to "
            f"{values.max():g}"
        )


def check_positive(name: str, value: float) -> None:
    """Raise `InputError` unless `value` is a finite number above zero."""
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{name}: expected a positive number, found {value:g}")


def check_pixels(name: str, width: int, height: int, most: int = MAX_PIXELS) -> None:
    """Raise `InputError` unless a picture of `width` x `height` has at most `most` pixels."""
    if width * height > most:
        raise InputError(f"{name}: expected at most {most} pixels, found {width} x {height}")


def check_product(name: str, frames: int, verts: int, most: int = MAX_MOVED_VERTICES) -> None:
    """Raise `InputError` if `frames` frames of a mesh of `verts` vertices are too many to keep."""
    if frames * verts > most:
        raise InputError(
            f"{name}: expected at most {most} vertices in all frames, found {frames} frames of {verts}"
        )


def shown(value: Any) -> str:
    """Show a foreign value in a message: one short line, and never an exception.

    Python itself refuses to print integers of more than 4300 digits, and runs out of stack where lists are
    nested deeply.
    """
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 4 * _SHOWN:
        return f"an integer of about {math.ceil(value.bit_length() * math.log10(2))} digits"
    if _is_array(value) and math.prod(value.shape) > 16:
        return f"an array of shape {list(value.shape)}"
    try:
        text = " ".join(_BRIEFLY.repr(value).split())
    except Exception:  # repr of a foreign value may raise anything
        return f"a {type(value).__name__} that cannot be shown"
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


def check_choice(name: str, value: Any, choices: Iterable[Any], kind: str = "names") -> None:
    """Raise `InputError` unless `value` is one of `choices`; the message says which one is nearest.

    Args:
        name: what to call the value in the message; include the file when there is one.
        value: what was given.
        choices: what is accepted.
        kind: what the choices are ("terms"), for lists that are too long to be recited.
    """
    accepted = list(choices)
    # An array cannot be a choice, and would compare entry by entry.
    if _is_array(value) or value not in accepted:
        raise InputError(f"{name}: {expected_among(value, accepted, kind)}")


def expected_among(value: Any, choices: Iterable[Any], kind: str = "names") -> str:
    """The part of a message on a value that is none of the choices: expected, found, and a suggestion."""
    names = [str(choice) for choice in choices]
    near = nearest(value, names)
    recited = ", ".join(names) if len(names) <= _MOST_RECITED or not near else f"{len(names)} {kind}"
    return f"expected one of {recited}, found {shown(value)}{meant(near)}"


def nearest(value: Any, choices: Iterable[Any]) -> str | None:
    """The most similar choice, or None."""
    names = {str(choice).lower(): str(choice) for choice in choices}
    word = shown(value).strip("'\"").lower()
    found = difflib.get_close_matches(word, names, 1, _ALIKE)
    if not found and len(word) > 2:
        found = [name for name in names if name.startswith(word)][:1]
    return names[found[0]] if found else None


def meant(name: str | None) -> str:
    """A suggestion of `name` for the end of a sentence; empty for None."""
    return "" if name is None else f"; did you mean {name}?"


def found_at(path: Path) -> str:
    """What is at a path: "a file", "a folder", or "nothing" with a suggestion of a similar name."""
    if path.is_dir():
        return "a folder"
    return "a file" if path.exists() else f"nothing{meant(neighbour(path))}"


def neighbour(path: str | Path) -> str | None:
    """The file or folder beside a missing one with the most similar name."""
    folder = Path(path).parent
    try:
        near = nearest(Path(path).name, [entry.name for entry in islice(folder.iterdir(), _MOST_NEIGHBOURS)])
    except (OSError, ValueError):
        return None
    return None if near is None else str(folder / near)

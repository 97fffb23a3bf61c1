"""Checks at the border: one sentence that names the field, what was expected and what was found."""

from __future__ import annotations

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


def check_choice(name: str, value: Any, choices: Iterable[Any]) -> None:
    """Raise `InputError` unless `value` is one of `choices`."""
    accepted = list(choices)
    if value not in accepted:
        raise InputError(f"{name}: expected one of {', '.join(map(str, accepted))}, found {value!r}")

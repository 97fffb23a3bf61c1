"""Entries of a foreign dictionary: present, of the right type and shape, finite.

`where` is the text that names the entry in a message: the file, then the path of keys, as in
`clip/build/data.npy: entities.right.hand_poses`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from bigs.checks import InputError, check_finite, check_positive, check_shape, shown

# In metres, pixels, radians and counts no plausible number is larger, and squares of larger ones overflow
# float32.
LARGEST = 1e15


def mapping_entry(where: str, value: Any) -> Mapping[str, Any]:
    """`value` if it is a dictionary, else an InputError."""
    if not isinstance(value, Mapping):
        raise InputError(f"{where}: expected a dictionary, found {type(value).__name__}")
    return value


def array_entry(where: str, value: Any, shape: Sequence[int | str], *, finite: bool = True) -> np.ndarray:
    """`value` (numpy or torch) as float64 of `shape`, finite unless told otherwise, else an InputError."""
    array = _numbers(where, value)
    check_shape(where, array, shape)
    if finite:
        check_finite(where, array)
    return array


def flat_entry(where: str, value: Any, *, finite: bool = True) -> np.ndarray:
    """`value` as float64 without axes, [N], for entries whose writers disagree about theirs."""
    array = _numbers(where, value).ravel()
    if finite:
        check_finite(where, array)
    return array


def number_entry(where: str, value: Any) -> float:
    """`value` as a finite number, alone or in an array; a truth value is none. Else an InputError."""
    array = _numbers(where, value)
    dtype = value.dtype if isinstance(value, torch.Tensor) else np.asarray(value).dtype
    is_truth_value = dtype in (torch.bool, np.dtype(bool))
    if array.size != 1 or is_truth_value:
        raise InputError(f"{where}: expected one number, found {shown(value)}")
    check_finite(where, array.reshape(()))
    return float(array.reshape(()))


def positive_entry(where: str, value: Any) -> float:
    """`number_entry` of a number above zero."""
    number = number_entry(where, value)
    check_positive(where, number)
    return number


def _numbers(where: str, value: Any) -> np.ndarray:
    """`value` as float64, NaN and infinities as they are."""
    _check_no_text(where, value)
    try:
        array = np.asarray(value.detach().cpu() if isinstance(value, torch.Tensor) else value)
    except (ValueError, TypeError, RuntimeError, OverflowError) as error:
        # Rows of different lengths, and tensors that numpy does not know.
        raise InputError(
            f"{where}: expected an array of numbers, found another thing ({shown(str(error))})"
        ) from None
    if array.dtype.kind not in "fiub":
        raise InputError(f"{where}: expected an array of numbers, found {_kind(value, array)}")
    with np.errstate(over="ignore"):  # wider floats become infinite
        array = array.astype(np.float64)
    largest = np.abs(array[np.isfinite(array)]).max(initial=0.0)
    if largest > LARGEST:
        raise InputError(f"{where}: expected numbers of at most {LARGEST:g}, found {largest:.3g}")
    return array


def _check_no_text(where: str, value: Any) -> None:
    """Refuse text in lists before NumPy makes every member as long as the longest."""
    waiting = list(value) if isinstance(value, list | tuple) else []
    while waiting:
        part = waiting.pop()
        if isinstance(part, list | tuple):
            waiting += part
        elif isinstance(part, str | bytes):
            raise InputError(f"{where}: expected an array of numbers, found {shown(value)}")


def _kind(value: Any, array: np.ndarray) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of {array.dtype}"
    return shown(value) if isinstance(value, int) else type(value).__name__


def require(where: str, values: Mapping[str, Any], key: str) -> Any:
    """`values[key]`, or an InputError that lists what is there; `where` names the key in full."""
    if key not in values:
        keys = [key if isinstance(key, str) else shown(key) for key in values]
        found = ", ".join(keys[:8]) + (", ..." if len(keys) > 8 else "")
        raise InputError(f"{where}: expected this field, found {f'only {found}' if keys else 'no fields'}")
    return values[key]

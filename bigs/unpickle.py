"""Reading other people's pickles without running anything they ask for.

A pickle is a program that may name any function. `bigs.pickle_records` runs it with every call replaced by an
inert record of what was asked for. Here the records become arrays, sparse matrices and tensors, by code that
checks types, sizes and indices. (Handing a pickle the real `numpy.dtype` is not safe: a forged dtype state
lets raw bytes pass for object pointers.)
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import scipy.sparse
import torch

from bigs.archives import npy_header, read_array
from bigs.checks import InputError
from bigs.files import open_regular
from bigs.pickle_records import (
    ARRAYS,
    CHUMPY,
    SPARSE,
    STORAGE_DTYPES,
    TENSORS,
    Global,
    PersistentId,
    Record,
    Refused,
    load_records,
)

_DTYPE_CODE = re.compile(r"[<>|=]?(b1|\?|[iu][1248]|f[248]|c8|c16|S\d+|U\d+|O[48]?)")
_TORCH_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C


def restricted_load(file: BinaryIO, *, name: str, allow: frozenset[Global] = ARRAYS) -> Any:
    """The first pickle in `file`: plain containers, numbers, strings, arrays and what `allow` adds.

    Python 2 strings are decoded as latin-1. Array subclasses and structured dtypes are refused too.

    Args:
        file: open for reading, in binary mode.
        name: what to call it in messages, usually its path.
        allow: one of `CONTAINERS`, `ARRAYS`, `SPARSE`, `CHUMPY`, `TENSORS`, or a union of them.

    Returns:
        Containers of numpy arrays and scalars, `scipy.sparse` CSC or CSR matrices, and torch tensors; a
        chumpy object is replaced by the array it stands for, an ordered dict by a dict.

    Raises:
        InputError: the pickle names anything else, or is damaged.
    """
    try:
        return _Builder(allow).value(load_records(io.BytesIO(file.read()), allow))
    except Refused as refusal:
        raise InputError(
            f"{name}: expected a pickle of plain data, found the global '{refusal}', which is refused "
            "because it could run code"
        ) from None
    except Exception as error:  # pickle promises no particular exception for malformed data
        reason = str(error) or type(error).__name__
        raise InputError(f"{name}: expected a readable pickle of plain data, found: {reason}") from error


def load_npy(path: str | Path, *, allow: frozenset[Global] = TENSORS) -> Any:
    """What `np.save` wrote: an array, or the object that was saved as an object array of shape ().

    Raises:
        InputError: there is no such file, or it is not an .npy file, or `restricted_load` refuses it.
    """
    with open_regular(path, "an .npy file") as file:
        _, dtype = npy_header(str(path), file)
        if not dtype.hasobject:
            size = file.seek(0, io.SEEK_END)
            file.seek(0)
            return read_array(str(path), file, size)
        if dtype != np.dtype(object):
            raise InputError(f"{path}: expected an array of numbers or of objects, found dtype {dtype}")
        array = restricted_load(file, name=str(path), allow=allow)
    if not isinstance(array, np.ndarray):
        raise InputError(f"{path}: expected a pickled object array, found {type(array).__name__}")
    return array.item() if array.shape == () else array


class _Builder:
    """Turns records into values, depth first. Shared parts stay shared; a cycle is an error."""

    def __init__(self, allow: frozenset[Global]) -> None:
        self._allow = allow
        self._done: dict[int, Any] = {}
        self._active: set[int] = set()
        # Keeps every visited object alive, so that an id in `_done` cannot come to mean another object.
        self._alive: list[Any] = []

    def value(self, raw: Any) -> Any:
        if raw is None or type(raw) in (bool, int, float, complex, str, bytes):
            return raw
        if id(raw) in self._done:
            return self._done[id(raw)]
        if id(raw) in self._active:
            raise ValueError("an object that contains itself")
        self._active.add(id(raw))
        self._alive.append(raw)
        result = self._record(raw) if isinstance(raw, Record) else self._container(raw)
        self._active.discard(id(raw))
        self._done[id(raw)] = result
        return result

    def _container(self, raw: Any) -> Any:
        if type(raw) is dict:
            return {self.value(key): self.value(item) for key, item in raw.items()}
        if type(raw) in (list, tuple, set, frozenset):
            return type(raw)([self.value(item) for item in raw])
        if type(raw) is bytearray:
            return bytes(raw)
        what = ".".join(raw.key) if isinstance(raw, type) and issubclass(raw, Record) else type(raw).__name__
        raise TypeError(f"{what} where data should be")

    def _record(self, record: Record) -> Any:
        if record.key == ("copyreg", "_reconstructor"):
            state, (cls, *_) = record.state, record.args
            if not (isinstance(cls, type) and issubclass(cls, Record)):
                raise TypeError("copyreg._reconstructor of something that is not a class")
            record = cls()
            record.state = state
        builder = _BUILDERS.get(record.key)
        if builder is None:
            raise TypeError(f"{'.'.join(record.key)} where data should be")
        return builder(self, record)

    def buffer(self, raw: Any) -> bytes:
        """The bytes of `raw`; Python 2 wrote them as a string, which came here as latin-1."""
        data = self.value(raw)
        if isinstance(data, str):
            return data.encode("latin1")
        if not isinstance(data, bytes):
            raise TypeError(f"{type(data).__name__} where bytes should be")
        return data

    def storage(self, raw: bytes) -> torch.Tensor:
        """A flat tensor from the stream in which `torch.save` wrote one storage before it used zip files."""
        stream = io.BytesIO(raw)
        magic, version, system = (load_records(stream, frozenset()) for _ in range(3))
        if magic != _TORCH_LEGACY_MAGIC or version != 1001 or system.get("little_endian") is not True:
            raise ValueError("a torch storage of an unknown format")
        reference = load_records(stream, self._allow, persistent=True)
        keys = load_records(stream, frozenset())
        if type(reference) is not PersistentId:
            raise TypeError("a torch storage that is not a storage")
        kind, storage_type, key, _location, count, *view = reference.args[0]
        if kind != "storage" or keys != [key] or any(part is not None for part in view):
            raise ValueError("a torch storage of an unknown kind")
        dtype = STORAGE_DTYPES[storage_type.key[1]]
        if int.from_bytes(stream.read(8), "little") != count:
            raise ValueError("a torch storage of another length than announced")
        return torch.from_numpy(_from_bytes(stream.read(count * dtype.itemsize), dtype, (count,), "C"))


def _from_bytes(data: bytes, dtype: np.dtype, shape: tuple[int, ...], order: Any) -> np.ndarray:
    flat = np.frombuffer(data, dtype) if data else np.empty(0, dtype)
    return np.reshape(flat, shape, order="F" if order == "F" else "C").copy(order="K")


def _shape(value: Any) -> tuple[int, ...]:
    if type(value) is not tuple or not all(isinstance(n, int | np.integer) and n >= 0 for n in value):
        raise ValueError(f"the array shape {value!r}")
    return tuple(int(n) for n in value)


def _build_dtype(builder: _Builder, record: Record) -> np.dtype:
    code = record.args[0]
    state = builder.value(record.state) or (3, "|", None, None, None)
    if (
        type(code) is not str
        or not _DTYPE_CODE.fullmatch(code)
        or any(part is not None for part in state[2:5])
    ):
        raise ValueError(f"the array type {code!r}")
    dtype = np.dtype("O" if code[:1] == "O" else code)
    return dtype.newbyteorder(">") if state[1] == ">" else dtype


def _build_array(builder: _Builder, record: Record) -> np.ndarray:
    cls = record.args[0]
    if not (isinstance(cls, type) and issubclass(cls, Record) and cls.key == ("numpy", "ndarray")):
        raise TypeError("an array that is not a plain numpy.ndarray")
    _version, raw_shape, raw_dtype, fortran, data = record.state
    shape, dtype = _shape(builder.value(raw_shape)), builder.value(raw_dtype)
    if dtype != np.dtype(object):
        return _from_bytes(builder.buffer(data), dtype, shape, "F" if fortran else "C")
    items = builder.value(data)
    array = np.empty(len(items), object)
    for index, item in enumerate(items):
        array[index] = item
    return np.reshape(array, shape, order="F" if fortran else "C")


def _build_array_from_buffer(builder: _Builder, record: Record) -> np.ndarray:
    data, raw_dtype, raw_shape, order, *axes = record.args
    dtype, shape = builder.value(raw_dtype), _shape(builder.value(raw_shape))
    array = _from_bytes(builder.buffer(data), dtype, shape, order)
    return array.transpose(builder.value(axes[0])) if order == "K" and axes else array


def _build_scalar(builder: _Builder, record: Record) -> Any:
    dtype, data = builder.value(record.args[0]), builder.buffer(record.args[1])
    return _from_bytes(data, dtype, (), "C")[()]


def _build_sparse(builder: _Builder, record: Record) -> Any:
    state = builder.value(record.state)
    matrix_type = getattr(scipy.sparse, record.key[1])
    parts = tuple(np.asarray(state[part]) for part in ("data", "indices", "indptr"))
    matrix = matrix_type(parts, shape=_shape(state["_shape"] if "_shape" in state else state["shape"]))
    # SciPy's compiled loops trust the indices; this is what looks at every one of them.
    matrix.check_format(full_check=True)
    return matrix


def _build_chumpy(builder: _Builder, record: Record) -> np.ndarray:
    """A `Ch` holds its array as `x`; a `Select` takes `idxs` of `a`, flattened, into `preferred_shape`."""
    state = record.state
    if record.key[1] == "Ch":
        return np.asarray(builder.value(state["x"]))
    source = np.asarray(builder.value(state["a"]))
    picked = source.ravel()[np.asarray(builder.value(state["idxs"]))]
    return picked.reshape(builder.value(state["preferred_shape"])) if "preferred_shape" in state else picked


def _build_tensor(builder: _Builder, record: Record) -> torch.Tensor:
    storage, offset, size, stride = (builder.value(part) for part in record.args[:4])
    if not isinstance(storage, torch.Tensor):
        raise TypeError("a torch tensor without a storage")
    size, stride = _shape(size), _shape(stride)
    # A stride of 0 could announce a tensor far larger than the file that holds it.
    if math.prod(size) > storage.numel():
        raise ValueError(f"a torch tensor of size {list(size)} in a storage of {storage.numel()} values")
    return storage.as_strided(size, stride, offset).clone()


def _build_from_iterable(make: type) -> Callable[[_Builder, Record], Any]:
    return lambda builder, record: make(*(builder.value(arg) for arg in record.args[:1]))


def _build_dict(builder: _Builder, record: Record) -> dict[Any, Any]:
    given = dict(builder.value(record.args[0])) if record.args else {}
    return given | builder.value(getattr(record, "entries", {}))


def _build_encoded(builder: _Builder, record: Record) -> bytes:
    """Python 3 writes bytes as `codecs.encode(text, "latin1")` in the protocols that Python 2 can read."""
    if record.args[1:] not in (("latin1",), ("latin-1",)):
        raise ValueError(f"the text encoding {record.args[1:]!r}")
    return builder.value(record.args[0]).encode("latin1")


_BUILDERS: dict[Global, Callable[[_Builder, Record], Any]] = {
    ("builtins", "set"): _build_from_iterable(set),
    ("builtins", "frozenset"): _build_from_iterable(frozenset),
    ("builtins", "bytes"): lambda builder, record: builder.buffer(record.args[0]) if record.args else b"",
    ("_codecs", "encode"): _build_encoded,
    ("numpy", "dtype"): _build_dtype,
    ("numpy.core.multiarray", "_reconstruct"): _build_array,
    ("numpy.core.multiarray", "scalar"): _build_scalar,
    ("numpy.core.numeric", "_frombuffer"): _build_array_from_buffer,
    **dict.fromkeys(SPARSE - ARRAYS, _build_sparse),
    **dict.fromkeys(CHUMPY - SPARSE, _build_chumpy),
    ("torch", "Size"): _build_from_iterable(tuple),
    ("torch._utils", "_rebuild_tensor"): _build_tensor,
    ("torch._utils", "_rebuild_tensor_v2"): _build_tensor,
    ("collections", "OrderedDict"): _build_dict,
    ("torch.storage", "_load_from_bytes"): lambda builder, record: builder.storage(
        builder.buffer(record.args[0])
    ),
}

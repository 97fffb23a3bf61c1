"""Reading other people's pickles without running anything they ask for.

A pickle is a program that may name any function. `bigs.pickle_records` runs it with every call replaced by an
inert record of what was asked for. Here the records become arrays, sparse matrices and tensors, by code that
checks types, sizes and indices, and counts what it makes: a kilobyte can share its parts level by level, or
announce a matrix of terabytes. (Handing a pickle the real `numpy.dtype` is not safe: a forged dtype state
lets raw bytes pass for object pointers.)
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import scipy.sparse
import torch

from bigs.archives import npy_header, read_array
from bigs.checks import InputError, shown
from bigs.files import open_regular
from bigs.pickle_records import (
    ARRAYS,
    CHUMPY,
    MAX_DEPTH,
    MAX_VALUES,
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
# Memory per byte of a file: text becomes bytes, a storage, a tensor. Small files may use more.
_MADE_PER_BYTE, _MADE_AT_LEAST = 8, 32 << 20
# Bytes per member of a list, dictionary or set.
_BYTES_PER_MEMBER = 64
# Limit of a sparse matrix that will be made dense; MANO's 4000 vertices have 64 000.
MAX_SPARSE_VALUES = 1 << 24
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
        data = file.read()
        return Builder(allow, len(data)).value(load_records(io.BytesIO(data), allow))
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


class Builder:
    """Turns records into values, depth first. Shared parts stay shared; a cycle is an error.

    `bigs.torch_files` adds what only files of torch have.
    """

    def __init__(self, allow: frozenset[Global], size: int) -> None:
        """`size` is that of the file in bytes, which bounds what is made of it."""
        self._allow = allow
        self._most = MAX_VALUES + 2 * size
        self._left = _MADE_AT_LEAST + _MADE_PER_BYTE * size
        self._sizes: dict[int, int] = {}  # of results, with everything shared written out
        self._done: dict[int, Any] = {}
        self._active: set[int] = set()
        # Keeps every visited object alive, so that an id in `_done` is not used again.
        self._alive: list[Any] = []

    def value(self, raw: Any) -> Any:
        if raw is None or type(raw) in (bool, int, float, complex, str, bytes):
            return raw
        if id(raw) in self._done:
            return self._done[id(raw)]
        if id(raw) in self._active:
            raise ValueError("an object that contains itself")
        if len(self._active) >= MAX_DEPTH:
            raise ValueError(f"data nested more than {MAX_DEPTH} levels deep")
        self._active.add(id(raw))
        self._alive.append(raw)
        result = self.record(raw) if isinstance(raw, Record) else self._container(raw)
        self._active.discard(id(raw))
        self._done[id(raw)] = result
        self._count(result)
        return result

    def spend(self, count: int) -> None:
        """Count bytes that are about to be allocated, or have just been.

        Raises:
            ValueError: they are out of proportion to the file.
        """
        self._left -= count
        if self._left < 0:
            raise ValueError("more data than a file of this size can hold")

    def size(self, value: Any) -> int:
        """How many values there are in a result of `value`, with everything shared written out."""
        return self._sizes.get(id(value), 1) if not isinstance(value, str | bytes) else 1 + len(value)

    def _count(self, result: Any) -> None:
        if isinstance(result, dict):
            size = 1 + sum(self.size(key) + self.size(item) for key, item in result.items())
            made = 2 * _BYTES_PER_MEMBER * len(result)
        elif isinstance(result, list | tuple | set | frozenset):
            size, made = 1 + sum(map(self.size, result)), _BYTES_PER_MEMBER * len(result)
        elif isinstance(result, np.ndarray):
            inside = sum(map(self.size, result.ravel())) if result.dtype.hasobject else result.size
            size, made = 1 + inside, result.nbytes
        elif isinstance(result, torch.Tensor):
            size, made = 1 + result.numel(), result.nbytes
        elif isinstance(result, str | bytes):
            size, made = 1 + len(result), len(result)
        else:
            size, made = 1, _BYTES_PER_MEMBER
        if size > self._most:
            raise ValueError(
                "more values than a file of this size can hold, once shared parts are written out"
            )
        self._sizes[id(result)] = size
        self.spend(made)

    def keys(self, values: Iterable[Any]) -> list[Any]:
        """Values that are about to be hashed."""
        listed = list(values)
        self.spend(_BYTES_PER_MEMBER * sum(map(self.size, listed)))
        return listed

    def _container(self, raw: Any) -> Any:
        if type(raw) is dict:
            keys = self.keys(map(self.value, raw))
            return dict(zip(keys, map(self.value, raw.values()), strict=True))
        if type(raw) in (list, tuple, set, frozenset):
            items = [self.value(item) for item in raw]
            return type(raw)(items if type(raw) in (list, tuple) else self.keys(items))
        if type(raw) is bytearray:
            return bytes(raw)
        what = ".".join(raw.key) if isinstance(raw, type) and issubclass(raw, Record) else type(raw).__name__
        raise TypeError(f"{what} where data should be")

    def record(self, record: Record) -> Any:
        """The value that a record stands for."""
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
        self.spend(self.size(data))
        if isinstance(data, str):
            return data.encode("latin1")
        if not isinstance(data, bytes):
            raise TypeError(f"{type(data).__name__} where bytes should be")
        return data

    def storage(self, raw: bytes) -> torch.Tensor:
        """A flat tensor from the stream in which `torch.save` wrote one storage before it used zip files."""
        stream = io.BytesIO(raw)
        check_legacy_head(stream)
        reference = load_records(stream, self._allow, references=[])
        keys = load_records(stream, frozenset())
        if type(reference) is not PersistentId:
            raise TypeError("a torch storage that is not a storage")
        kind, storage_type, key, _location, count, *view = reference.args[0]
        if type(kind) is not str or type(key) is not str or len(keys) != 1:
            raise TypeError("a torch storage of an unknown kind")
        if kind != "storage" or keys != [key] or any(part is not None for part in view):
            raise ValueError("a torch storage of an unknown kind")
        dtype = STORAGE_DTYPES[storage_type.key[1]]
        if int.from_bytes(stream.read(8), "little") != count:
            raise ValueError("a torch storage of another length than announced")
        return torch.from_numpy(_from_bytes(stream.read(count * dtype.itemsize), dtype, (count,), "C"))


def check_legacy_head(stream: io.BytesIO) -> None:
    """Read the three pickles with which torch began its files before they were zip files; ValueError if there
    are others."""
    magic, version, system = (load_records(stream, frozenset()) for _ in range(3))
    little = type(system) is dict and system.get("little_endian") is True
    if magic != _TORCH_LEGACY_MAGIC or version != 1001 or not little:
        raise ValueError("no file of torch, or one of an unknown format")


def _from_bytes(data: bytes, dtype: np.dtype, shape: tuple[int, ...], order: Any) -> np.ndarray:
    flat = np.frombuffer(data, dtype) if data else np.empty(0, dtype)
    return np.reshape(flat, shape, order="F" if order == "F" else "C").copy(order="K")


def _shape(value: Any) -> tuple[int, ...]:
    if type(value) is not tuple or not all(isinstance(n, int | np.integer) and n >= 0 for n in value):
        raise ValueError(f"the array shape {shown(value)}")
    return tuple(int(n) for n in value)


def _build_dtype(builder: Builder, record: Record) -> np.dtype:
    code = record.args[0]
    state = builder.value(record.state) or (3, "|", None, None, None)
    if (
        type(code) is not str
        or not _DTYPE_CODE.fullmatch(code)
        or any(part is not None for part in state[2:5])
    ):
        raise ValueError(f"the array type {shown(code)}")
    dtype = np.dtype("O" if code[:1] == "O" else code)
    return dtype.newbyteorder(">") if state[1] == ">" else dtype


def _dtype(builder: Builder, raw: Any) -> np.dtype:
    """A dtype that is one: NumPy would make one of a list, and of what the list holds."""
    dtype = builder.value(raw)
    if not isinstance(dtype, np.dtype):
        raise TypeError(f"{type(dtype).__name__} where an array type should be")
    return dtype


def _plain_numbers(builder: Builder, raw: Any) -> np.ndarray:
    """An array of numbers, or a list of some as one; never of text, which NumPy pads to the longest."""
    value = builder.value(raw)
    waiting = [value]
    while waiting:
        part = waiting.pop()
        if type(part) in (list, tuple):
            waiting += part
        elif not isinstance(part, bool | int | float | np.number | np.ndarray):
            raise TypeError(f"{type(part).__name__} where numbers should be")
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise TypeError(f"an array of {array.dtype} where numbers should be")
    return array


def _build_array(builder: Builder, record: Record) -> np.ndarray:
    cls = record.args[0]
    if not (isinstance(cls, type) and issubclass(cls, Record) and cls.key == ("numpy", "ndarray")):
        raise TypeError("an array that is not a plain numpy.ndarray")
    _version, raw_shape, raw_dtype, fortran, data = record.state
    shape, dtype = _shape(builder.value(raw_shape)), _dtype(builder, raw_dtype)
    if dtype != np.dtype(object):
        return _from_bytes(builder.buffer(data), dtype, shape, "F" if fortran else "C")
    items = builder.value(data)
    array = np.empty(len(items), object)
    for index, item in enumerate(items):
        array[index] = item
    return np.reshape(array, shape, order="F" if fortran else "C")


def _build_array_from_buffer(builder: Builder, record: Record) -> np.ndarray:
    data, raw_dtype, raw_shape, order, *axes = record.args
    dtype, shape = _dtype(builder, raw_dtype), _shape(builder.value(raw_shape))
    array = _from_bytes(builder.buffer(data), dtype, shape, order)
    return array.transpose(builder.value(axes[0])) if order == "K" and axes else array


def _build_scalar(builder: Builder, record: Record) -> Any:
    dtype, data = _dtype(builder, record.args[0]), builder.buffer(record.args[1])
    return _from_bytes(data, dtype, (), "C")[()]


def _build_sparse(builder: Builder, record: Record) -> Any:
    state = record.state
    matrix_type = getattr(scipy.sparse, record.key[1])
    parts = tuple(_plain_numbers(builder, state[part]) for part in ("data", "indices", "indptr"))
    shape = _shape(builder.value(state["_shape"] if "_shape" in state else state["shape"]))
    if math.prod(shape) > MAX_SPARSE_VALUES:
        raise ValueError(
            f"a sparse matrix of shape {shown(list(shape))}, of more than {MAX_SPARSE_VALUES} values"
        )
    builder.spend(sum(part.nbytes for part in parts))
    matrix = matrix_type(parts, shape=shape)
    # SciPy's compiled loops do not check the indices, so every one is checked here.
    matrix.check_format(full_check=True)
    return matrix


def _build_chumpy(builder: Builder, record: Record) -> np.ndarray:
    """A `Ch` holds its array as `x`; a `Select` takes `idxs` of `a`, flattened, into `preferred_shape`."""
    state = record.state
    if record.key[1] == "Ch":
        return _plain_numbers(builder, state["x"])
    source, index = (_plain_numbers(builder, state[key]) for key in ("a", "idxs"))
    picked = source.ravel()[index]
    if "preferred_shape" not in state:
        return picked
    return picked.reshape(_plain_numbers(builder, state["preferred_shape"]).tolist())


def _build_tensor(builder: Builder, record: Record) -> torch.Tensor:
    storage, offset, size, stride = (builder.value(part) for part in record.args[:4])
    if not isinstance(storage, torch.Tensor):
        raise TypeError("a torch tensor without a storage")
    size, stride = _shape(size), _shape(stride)
    # With a stride of 0, a tensor could be far larger than its file.
    if math.prod(size) > storage.numel():
        raise ValueError(f"a torch tensor of size {list(size)} in a storage of {storage.numel()} values")
    tensor = storage.as_strided(size, stride, offset)
    is_all = tensor.numel() == storage.numel() and tensor.is_contiguous()
    return tensor if is_all else tensor.clone()


def _build_from_iterable(make: type) -> Callable[[Builder, Record], Any]:
    def build(builder: Builder, record: Record) -> Any:
        given = [builder.value(arg) for arg in record.args[:1]]
        return make(*(value if make is tuple else builder.keys(value) for value in given))

    return build


def build_dict(builder: Builder, record: Record) -> dict[Any, Any]:
    """A dict from a record of one, as it was made and with the entries that were stored later."""
    given = builder.value(record.args[0]) if record.args else {}
    builder.spend(_BYTES_PER_MEMBER * builder.size(given))
    return dict(given) | builder.value(getattr(record, "entries", {}))


def _build_encoded(builder: Builder, record: Record) -> bytes:
    """Python 3 writes bytes as `codecs.encode(text, "latin1")` in the protocols that Python 2 can read."""
    if record.args[1:] not in (("latin1",), ("latin-1",)):
        raise ValueError(f"the text encoding {shown(record.args[1:])}")
    return builder.value(record.args[0]).encode("latin1")


_BUILDERS: dict[Global, Callable[[Builder, Record], Any]] = {
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
    ("collections", "OrderedDict"): build_dict,
    ("torch.storage", "_load_from_bytes"): lambda builder, record: builder.storage(
        builder.buffer(record.args[0])
    ),
}

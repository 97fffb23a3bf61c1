"""What `torch.save` wrote, read as data: sizes are compared with the file before anything is made of it.

`torch.load(weights_only=True)` runs no code, but makes what a file announces: keys of 2^n parts, buffers of
any length, members that unpack to gigabytes. Here the pickle is counted and read by `bigs.pickle_records`,
and a tensor is never larger than the bytes that are there for it.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from typing import Any, BinaryIO, NamedTuple

import torch

from bigs.archives import open_zip, read_member
from bigs.checks import InputError, shown
from bigs.pickle_records import HOLD_DICTIONARY, TENSORS, Global, PersistentId, Record, load_records
from bigs.unpickle import Builder, build_dict, check_legacy_head

_DTYPES: dict[str, torch.dtype] = {
    "DoubleStorage": torch.float64,
    "FloatStorage": torch.float32,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}
_PARAMETER: Global = ("torch._utils", "_rebuild_parameter")
_ALLOW = TENSORS | {("torch", "BFloat16Storage"), _PARAMETER, HOLD_DICTIONARY}
# The first bytes of a zip file, which torch saves since version 1.6; VGG-16's weights are older.
_ZIP_MAGIC = b"PK\x03\x04"
# Limit of the pickle in such a file; that of a network with 10 000 tensors has 2 MB.
_MAX_PICKLE_BYTES = 64 << 20


def load_torch(where: str, stream: BinaryIO, what: str) -> Any:
    """Plain containers, numbers, texts and tensors from a file that `torch.save` wrote.

    Tensors are on the CPU; parameters are tensors, dictionaries of other classes dicts.

    Args:
        where: what to call it in messages, usually its path.
        stream: its bytes, which can be sought in; stays open.
        what: what it should hold, for messages.

    Raises:
        InputError: it is damaged, announces more than it has, or holds anything else.
    """
    try:
        stream.seek(0)
        begins_as_zip = stream.read(len(_ZIP_MAGIC)) == _ZIP_MAGIC
        stream.seek(0)
        return _read_zip(where, stream, what) if begins_as_zip else _read_legacy(stream)
    except InputError:
        raise
    except Exception as error:  # pickle promises no particular exception for malformed data
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(
            f"{where}: expected {what}, found data that cannot be read safely ({shown(reason[-1])})"
        ) from None


class _Announced(NamedTuple):
    """A pickle's description of data beside it."""

    key: str
    dtype: torch.dtype
    length: int

    @property
    def size(self) -> int:
        """In bytes."""
        return self.length * self.dtype.itemsize


class _TorchBuilder(Builder):
    """Records of a whole file, whose tensors' data lie beside the pickle."""

    def __init__(self, size: int, fetch: Callable[[_Announced], bytes]) -> None:
        """`size` is that of the file in bytes; `fetch` is asked once for the bytes of each storage."""
        super().__init__(_ALLOW, size)
        self._fetch = fetch
        self._storages: dict[_Announced, torch.Tensor] = {}

    def record(self, record: Record) -> Any:
        if type(record) is PersistentId:
            announced = _announced(record)
            if announced not in self._storages:
                self._storages[announced] = self._stored(announced)
            return self._storages[announced]
        if record.key == _PARAMETER:
            return self.value(record.args[0])
        if record.key == HOLD_DICTIONARY:
            return build_dict(self, record)
        return super().record(record)

    def _stored(self, announced: _Announced) -> torch.Tensor:
        """A storage as a flat tensor."""
        data = self._fetch(announced)
        if len(data) != announced.size:
            raise ValueError(
                f"storage {shown(announced.key)} of {announced.size} bytes of which {len(data)} are there"
            )
        if not data:
            return torch.empty(0, dtype=announced.dtype)
        # A copy, because torch has no read-only tensors.
        return torch.frombuffer(bytearray(data), dtype=announced.dtype)


def _announced(reference: PersistentId) -> _Announced:
    kind, storage, key, _location, count, *view = reference.args[0]
    if kind != "storage" or type(key) is not str or any(part is not None for part in view):
        raise ValueError("a torch storage of an unknown kind")
    if type(count) is not int or count < 0:
        raise ValueError(f"a torch storage of {shown(count)} values")
    if not (isinstance(storage, type) and issubclass(storage, Record) and storage.key[1] in _DTYPES):
        raise TypeError("a torch storage of an unknown type")
    return _Announced(key, _DTYPES[storage.key[1]], count)


def _read_zip(where: str, stream: BinaryIO, what: str) -> Any:
    size = stream.seek(0, io.SEEK_END)
    with open_zip(where, stream, what) as archive:
        members = {info.filename: info for info in archive.infolist()}
        programs = [name for name in members if name.partition("/")[2] == "data.pkl"]
        if len(programs) != 1:
            raise ValueError(f"{len(programs)} members called data.pkl")
        packed = [name for name, info in members.items() if info.compress_type != zipfile.ZIP_STORED]
        if packed:
            raise ValueError(f"a packed member {shown(packed[0])}, as torch writes none")
        if members[programs[0]].file_size > _MAX_PICKLE_BYTES:
            raise ValueError(f"a pickle of more than {_MAX_PICKLE_BYTES} bytes")

        def member(name: str) -> bytes:
            return read_member(where, archive, members[f"{programs[0].partition('/')[0]}/{name}"])

        if f"{programs[0].partition('/')[0]}/byteorder" in members and member("byteorder") != b"little":
            raise ValueError("numbers that are not in little-endian order")
        records = load_records(io.BytesIO(member("data.pkl")), _ALLOW, references=[])
        return _TorchBuilder(size, lambda storage: member(f"data/{storage.key}")).value(records)


def _read_legacy(stream: BinaryIO) -> Any:
    """The format before zip files: five pickles, then the length and the bytes of each storage."""
    size = stream.seek(0, io.SEEK_END)
    stream.seek(0)
    content, references = io.BytesIO(stream.read()), list[PersistentId]()
    check_legacy_head(content)
    records = load_records(content, _ALLOW, references=references)
    announced = {storage.key: storage for storage in map(_announced, references)}
    data: dict[str, bytes] = {}
    for key in load_records(content, frozenset()):
        if int.from_bytes(content.read(8), "little") != announced[key].length:
            raise ValueError(f"storage {shown(key)} of another length than announced")
        data[key] = content.read(announced[key].size)
    return _TorchBuilder(size, lambda storage: data[storage.key]).value(records)

"""What a pickle asks for, as inert records: its program is run, but no call in it does anything.

Every name is checked against a short list, and even a name on the list is not what gets called.
`bigs.unpickle` turns the records into values.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import re
from typing import Any, BinaryIO

import numpy as np

Global = tuple[str, str]

# The names a pickle may use, as canonical (module, qualified name) pairs; see `_canonical`.
CONTAINERS: frozenset[Global] = frozenset(
    {
        ("builtins", "set"),
        ("builtins", "frozenset"),
        ("builtins", "object"),
        ("builtins", "bytes"),
        ("collections", "OrderedDict"),
        ("copyreg", "_reconstructor"),
        ("_codecs", "encode"),
    }
)
ARRAYS: frozenset[Global] = CONTAINERS | {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy.core.numeric", "_frombuffer"),
}
SPARSE: frozenset[Global] = ARRAYS | {
    (f"scipy.sparse.{kind}", f"{kind}_{form}") for kind in ("csc", "csr") for form in ("matrix", "array")
}
CHUMPY: frozenset[Global] = SPARSE | {("chumpy.ch", "Ch"), ("chumpy.reordering", "Select")}

STORAGE_DTYPES: dict[str, np.dtype] = {
    "DoubleStorage": np.dtype("<f8"),
    "FloatStorage": np.dtype("<f4"),
    "HalfStorage": np.dtype("<f2"),
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
    "ShortStorage": np.dtype("<i2"),
    "CharStorage": np.dtype("i1"),
    "ByteStorage": np.dtype("u1"),
    "BoolStorage": np.dtype("?"),
}
TENSORS: frozenset[Global] = ARRAYS | {
    ("torch", "Size"),
    ("torch._utils", "_rebuild_tensor"),
    ("torch._utils", "_rebuild_tensor_v2"),
    ("torch.storage", "_load_from_bytes"),
    *(("torch", storage) for storage in STORAGE_DTYPES),
}


class Refused(pickle.UnpicklingError):
    """A global that is not on the list; the message is its name."""


class Record:
    """An object as a pickle describes it: a name, arguments, and a state. Never has any behaviour."""

    __slots__ = ("args", "state")
    key: Global = ("", "")

    args: tuple[Any, ...]
    state: Any

    def __new__(cls, *args: Any) -> Record:
        record = object.__new__(cls)
        record.args = args
        record.state = None
        return record

    def __setstate__(self, state: Any) -> None:
        self.state = state


class PersistentId(Record):
    """A reference to data outside the pickle (used by torch)."""

    __slots__ = ()
    key = ("", "persistent id")


class _DictRecord(Record):
    """An ordered dict; the only record that items are stored into."""

    __slots__ = ("entries",)
    entries: dict[Any, Any]

    def __setitem__(self, key: Any, item: Any) -> None:
        if not hasattr(self, "entries"):
            self.entries = {}
        self.entries[key] = item


class _RecordingUnpickler(pickle.Unpickler):
    """Runs a pickle's program with every global replaced by a record class made for this one load."""

    def __init__(self, file: BinaryIO, allow: frozenset[Global], *, persistent: bool = False) -> None:
        super().__init__(file, encoding="latin1")
        self._allow = allow
        self._persistent = persistent
        self._classes: dict[Global, type[Record]] = {}

    def find_class(self, module: str, name: str) -> type[Record]:
        key = _canonical(module, name)
        if key not in self._allow:
            raise Refused(f"{module}.{name}")
        if key not in self._classes:
            base = _DictRecord if key == ("collections", "OrderedDict") else Record
            self._classes[key] = type(name, (base,), {"__slots__": (), "key": key})
        return self._classes[key]

    def persistent_load(self, pid: Any) -> Record:
        if not self._persistent:
            raise pickle.UnpicklingError("a reference to data outside the pickle")
        return PersistentId(pid)


def load_records(stream: io.BytesIO, allow: frozenset[Global], *, persistent: bool = False) -> Any:
    """The next pickle in `stream` with every global call left as a record."""
    start = stream.tell()
    # A few forged bytes can make the unpickler allocate gigabytes: a length beyond the end of the data (which
    # this walk over the program notices by itself), or a memo slot that no program of this size would reach.
    for count, (opcode, argument, _position) in enumerate(pickletools.genops(stream)):
        if opcode.name.endswith("PUT") and int(argument or 0) > count:
            raise ValueError(f"memo slot {argument} after {count} instructions")
    stream.seek(start)
    return _RecordingUnpickler(stream, allow, persistent=persistent).load()


def _canonical(module: str, name: str) -> Global:
    """One spelling for a global that Python 2, NumPy 1 and 2, and old and new SciPy spell differently."""
    module = {"__builtin__": "builtins", "copy_reg": "copyreg", "chumpy": "chumpy.ch"}.get(module, module)
    module = re.sub(r"^numpy\._core\b", "numpy.core", module)
    module = re.sub(r"^scipy\.sparse\._(csc|csr)$", r"scipy.sparse.\1", module)
    return module, name

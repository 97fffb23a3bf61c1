"""What a pickle asks for, as inert records: its program is run, but no call in it does anything.

Every name is checked against a short list, and even a name on the list is not what gets called. Before it is
run, its operations are counted, and how much there would be to hash: parts that are shared level by level
make a key of 2^n parts out of n operations.
`bigs.unpickle` turns the records into values.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import re
from collections.abc import Sequence
from typing import Any, BinaryIO, NamedTuple

import numpy as np

Global = tuple[str, str]

# A clip of 2000 frames takes 80 000 operations, MANO's own file 300.
MAX_OPERATIONS = 500_000
# Limits of values in a part with everything shared written out, and of values in keys.
MAX_VALUES = 1_000_000
# Data sets nest five levels deep; hashing and printing use the machine's stack for each level.
MAX_DEPTH = 50
# No data set has longer integers as keys, and such keys can be made to collide.
_LONG_INTEGER, _MAX_LONG_INTEGERS = 1 << 64, 1000
# Most arguments of a callable; a tensor has seven.
_MAX_ARGUMENTS = 16

# Classes whose instances are dictionaries; HOLD saves its predictions as the second.
HOLD_DICTIONARY: Global = ("common.xdict", "xdict")
DICTIONARIES: frozenset[Global] = frozenset({("collections", "OrderedDict"), HOLD_DICTIONARY})

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
    """A global that is not allowed; the message is its name."""


class Record:
    """An object as a pickle describes it: a name, arguments, and a state. Never has any behaviour."""

    __slots__ = ("args", "state")
    key: Global = ("", "")

    args: tuple[Any, ...]
    state: Any

    def __new__(cls, *args: Any) -> Record:
        if len(args) > _MAX_ARGUMENTS:
            raise ValueError(f"{cls.__name__} of {len(args)} arguments")
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
    """A dict of another class than `dict`; the only record that items are stored into."""

    __slots__ = ("entries",)
    entries: dict[Any, Any]

    def __setitem__(self, key: Any, item: Any) -> None:
        if not hasattr(self, "entries"):
            self.entries = {}
        self.entries[key] = item


class _RecordingUnpickler(pickle.Unpickler):
    """Runs a pickle's program with every global replaced by a record class made for this one load."""

    def __init__(
        self, file: BinaryIO, allow: frozenset[Global], references: list[PersistentId] | None
    ) -> None:
        super().__init__(file, encoding="latin1")
        self._allow = allow
        self._references = references
        self._classes: dict[Global, type[Record]] = {}

    def find_class(self, module: str, name: str) -> type[Record]:
        key = _canonical(module, name)
        if key not in self._allow:
            raise Refused(f"{module}.{name}")
        if key not in self._classes:
            base = _DictRecord if key in DICTIONARIES else Record
            self._classes[key] = type(name, (base,), {"__slots__": (), "key": key})
        return self._classes[key]

    def persistent_load(self, pid: Any) -> Record:
        if self._references is None:
            raise pickle.UnpicklingError("a reference to data outside the pickle")
        self._references.append(PersistentId(pid))
        return self._references[-1]


class _Part(NamedTuple):
    """The cost of hashing a value on the stack."""

    values: int = 1  # with everything shared written out
    depth: int = 0


_PLAIN = _Part()
_GETS, _PUTS = ("GET", "BINGET", "LONG_BINGET"), ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE")
_TUPLES = ("TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "FROZENSET")


class _Rehearsal:
    """Walks over a program before it runs, with counts instead of values.

    Tuples and frozen sets are the only values that are hashed with what they hold, and they never change, so
    that what is counted when one is made stays true.
    """

    def __init__(self) -> None:
        self._stack: list[_Part | None] = []  # None is a mark
        self._memo: dict[int, _Part] = {}
        self._hashed = 0
        self._long_integers = 0

    def follow(self, stream: io.BytesIO) -> None:
        """Raise ValueError at what takes more than it may.

        A length beyond the end of the data, for which the unpickler would allocate gigabytes, is noticed by
        the walk itself.
        """
        for count, (opcode, argument, _) in enumerate(pickletools.genops(stream)):
            if count >= MAX_OPERATIONS:
                raise ValueError(f"more than {MAX_OPERATIONS} operations")
            if type(argument) is int and abs(argument) >= _LONG_INTEGER:
                self._long_integers += 1
                if self._long_integers > _MAX_LONG_INTEGERS:
                    raise ValueError(f"more than {_MAX_LONG_INTEGERS} integers beyond 64 bits")
            try:
                self._take(opcode, argument, count)
            except IndexError:
                raise ValueError(f"{opcode.name} without what it needs") from None

    def _take(self, opcode: pickletools.OpcodeInfo, argument: Any, count: int) -> None:
        name, stack = opcode.name, self._stack
        if name == "MARK":
            stack.append(None)
        elif name == "POP":
            stack.pop()
        elif name == "DUP":
            stack.append(stack[-1])
        elif name in _GETS:
            stack.append(self._memo.get(int(argument), _PLAIN))
        elif name in _PUTS:
            slot = len(self._memo) if argument is None else int(argument)
            # The unpickler's memo is as long as its highest slot.
            if slot > count:
                raise ValueError(f"memo slot {slot} after {count} instructions")
            self._memo[slot] = stack[-1] or _PLAIN
        else:
            parts = self._popped(opcode)
            if name in ("DICT", "SETITEMS"):
                self._hash(parts[::2])
            elif name == "SETITEM":
                self._hash(parts[1:2])
            elif name in ("ADDITEMS", "FROZENSET"):
                self._hash(parts)
            if name in _TUPLES:
                stack.append(_whole(parts))
            else:
                stack += [_PLAIN] * len(opcode.stack_after)

    def _popped(self, opcode: pickletools.OpcodeInfo) -> list[_Part]:
        """The values that an operation pops: down to the last mark, or this many."""
        stack, before = self._stack, opcode.stack_before
        if pickletools.markobject not in before:
            parts = [stack.pop() or _PLAIN for _ in before]
            return parts[::-1]
        parts = []
        while (part := stack.pop()) is not None:
            parts.append(part)
        for _ in range(before.index(pickletools.markobject)):
            stack.pop()
        return parts[::-1]

    def _hash(self, keys: Sequence[_Part]) -> None:
        self._hashed += sum(key.values for key in keys)
        if self._hashed > MAX_VALUES:
            raise ValueError(f"keys of more than {MAX_VALUES} values")


def _whole(parts: Sequence[_Part]) -> _Part:
    values, depth = 1 + sum(part.values for part in parts), 1 + max((part.depth for part in parts), default=0)
    if values > MAX_VALUES:
        raise ValueError(f"a tuple of more than {MAX_VALUES} values")
    if depth > MAX_DEPTH:
        raise ValueError(f"tuples nested more than {MAX_DEPTH} levels deep")
    return _Part(values, depth)


def load_records(
    stream: io.BytesIO, allow: frozenset[Global], *, references: list[PersistentId] | None = None
) -> Any:
    """The next pickle in `stream` with every global call left as a record.

    Args:
        stream: at the pickle's beginning; left at its end.
        allow: the names that it may use.
        references: takes what it says of data outside itself; without it there must be none.
    """
    start = stream.tell()
    _Rehearsal().follow(stream)
    stream.seek(start)
    return _RecordingUnpickler(stream, allow, references).load()


def _canonical(module: str, name: str) -> Global:
    """One spelling for a global that Python 2, NumPy 1 and 2, and old and new SciPy spell differently."""
    module = {"__builtin__": "builtins", "copy_reg": "copyreg", "chumpy": "chumpy.ch"}.get(module, module)
    module = re.sub(r"^numpy\._core\b", "numpy.core", module)
    module = re.sub(r"^scipy\.sparse\._(csc|csr)$", r"scipy.sparse.\1", module)
    return module, name

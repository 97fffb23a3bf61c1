"""Small pickles that ask for much: parts shared level by level, forged shapes, endless repetition."""

from __future__ import annotations

import io
import pickle
import struct
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

from bigs import pickle_records
from bigs.checks import InputError
from bigs.data.formats.hold import load_hold
from bigs.hand.io import load_hand_model
from bigs.unpickle import CHUMPY, TENSORS, load_npy, restricted_load

ALLOW = CHUMPY | TENSORS


def shared(levels: int, leaf: Any = 1, make: Callable[[Any, Any], Any] = lambda a, b: (a, b)) -> Any:
    """2 ** levels leaves in a pickle of a few bytes a level."""
    value = leaf
    for _ in range(levels):
        value = make(value, value)
    return value


class Named:
    """Pickled as the global that its name says, with a state."""

    def __init__(self, state: Any) -> None:
        self.state = state

    def __getstate__(self) -> Any:
        return self.state


def as_global(text: bytes, value: Any) -> bytes:
    """A pickle of `value`, whose instances of `Named` are said to be of the class `text`."""
    content = pickle.dumps(value, 2)
    return content.replace(f"c{Named.__module__}\nNamed\n".encode(), b"c" + text)


def sparse(shape: tuple[int, ...]) -> bytes:
    state = {"_shape": shape, "data": np.ones(1), "indices": np.zeros(1, int), "indptr": np.zeros(4, int)}
    state["indptr"][1:] = 1
    return as_global(b"scipy.sparse.csc\ncsc_matrix\n", Named(state))


def array_with(shape: bytes, dtype: bytes) -> bytes:
    """An array whose shape and type are whatever these programs leave on the stack."""
    head = b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
    return head + b"(K\x01" + shape + dtype + b"\x89U\x08" + bytes(8) + b"tb."


def program(value: Any) -> bytes:
    """What leaves a value on the stack: a pickle without its ends."""
    return pickle.dumps(value, 2)[2:-1]


def with_keys(keys: list[int]) -> bytes:
    """`pickle.dumps` of a dictionary with these keys, which is never made: the keys may collide."""
    entries = [program(key) + b"K\x00" for key in keys]
    parts = [b"(" + b"".join(entries[i : i + 1000]) + b"u" for i in range(0, len(entries), 1000)]
    return b"\x80\x02}q\x00" + b"".join(parts) + b"."


F8 = b"cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
DEEP_TUPLE = b"\x80\x02)" + b"\x85" * 100_000
MIB = 1 << 20

HOSTILE: dict[str, bytes] = {
    "shared tuple as a key": b"\x80\x02}" + program(shared(40)) + b"K\x01s.",
    "shared tuple as one of the keys": b"\x80\x02}(" + program(shared(40)) + b"K\x01u.",
    "shared tuple in a set": b"\x80\x04\x8f(" + program(shared(40)) + b"\x90.",
    "shared tuple in a frozenset": b"\x80\x04(" + program(shared(40)) + b"\x91.",
    "shared frozensets": pickle.dumps(shared(60, 1, lambda a, b: frozenset([a, (b,)])), 4),
    "shared tuple": pickle.dumps(shared(60), 2),
    "shared list": pickle.dumps(shared(60, 1, lambda a, b: [a, b]), 2),
    "shared dictionaries": pickle.dumps(shared(60, 1, lambda a, b: {"a": a, "b": b}), 2),
    "an array many times": pickle.dumps(shared(20, np.zeros(1000), lambda a, b: [a, b]), 2),
    "a text many times": pickle.dumps(shared(20, "x" * 1000, lambda a, b: [a, b]), 2),
    "shared shape": array_with(program(shared(40)), F8),
    "shared list as a shape": array_with(program(shared(40, 1, lambda a, b: [a, b])), F8),
    "shared list as a type": array_with(b"K\x01\x85", program(shared(40, "f8", lambda a, b: [a, b]))),
    "terabytes as a shape": array_with(program((1 << 40,)), F8),
    "deep tuple": DEEP_TUPLE + b".",
    "deep tuple as a key": b"\x80\x02}" + DEEP_TUPLE[2:] + b"K\x01s.",
    "deep list": b"\x80\x02" + b"]" * 20_000 + b"a" * 19_999 + b".",
    "long integers as keys": with_keys([i * ((1 << 61) - 1) for i in range(1, 10_000)]),
    "arguments again and again": b"\x80\x02ccollections\nOrderedDict\nq\x00("
    + b"N" * 1000
    + b"tq\x010(h\x00h\x01R"
    + b"h\x00h\x01R" * 1000
    + b"t.",
    "a memo beyond the program": b"\x80\x02Nr\xff\xff\xff\x7f.",
    "bytes that are not there": b"\x80\x05\x96" + struct.pack("<Q", 1 << 40) + b".",
    "a stack that is empty": b"\x80\x02\x85.",
    "wide sparse matrix": sparse((1 << 40, 3)),
    "large sparse matrix": sparse((16, 1 << 60)),
    "text in a sparse matrix": as_global(
        b"scipy.sparse.csc\ncsc_matrix\n",
        Named({"_shape": (1, 1), "data": ["x" * 10_000, *[""] * 10_000], "indices": [0], "indptr": [0, 1]}),
    ),
    "text in a chumpy array": as_global(b"chumpy.ch\nCh\n", Named({"x": ["x" * 20_000, *[""] * 20_000]})),
}


@pytest.mark.parametrize("how", HOSTILE)
def test_small_pickles_take_little(how: str) -> None:
    tracemalloc.start()
    began = time.process_time()
    with pytest.raises(InputError, match=r"^file.pkl: expected a readable pickle") as refusal:
        restricted_load(io.BytesIO(HOSTILE[how]), name="file.pkl", allow=ALLOW)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 128 * MIB
    assert time.process_time() - began < 30
    assert len(str(refusal.value)) < 400


def test_operations_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pickle_records, "MAX_OPERATIONS", 1000)
    for count, refused in ((900, False), (1100, True)):
        content = io.BytesIO(b"\x80\x02(" + b"N" * count + b"t.")
        if refused:
            with pytest.raises(InputError, match="more than 1000 operations"):
                restricted_load(content, name="file.pkl", allow=ALLOW)
        else:
            assert len(restricted_load(content, name="file.pkl", allow=ALLOW)) == count


@pytest.mark.parametrize(
    "value",
    [
        {"hand_poses": shared(40, 0.5, lambda a, b: [a, b])},
        {"hand_poses": shared(25, np.zeros((5, 48)), lambda a, b: [a, b])},
        {"hand_poses": ["x" * 30_000, *[""] * 30_000]},
    ],
    ids=["shared lists", "shared arrays", "padded text"],
)
def test_poses_that_unfold(value: dict[str, Any], edit_small: Callable[..., Path]) -> None:
    folder = edit_small(value)
    tracemalloc.start()
    with pytest.raises(InputError, match=r"data.npy: "):
        load_hold(folder)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 64 * MIB


@pytest.fixture
def edit_small(tiny_clip: Path, tmp_path: Path) -> Callable[..., Path]:
    def edit(value: dict[str, Any]) -> Path:
        build = tmp_path / "clip" / "build"
        build.mkdir(parents=True)
        for part in ("image", "mask"):
            (build / part).symlink_to(tiny_clip / "build" / part)
        data = load_npy(tiny_clip / "build" / "data.npy")
        data["entities"]["right"].update(value)
        np.save(build / "data.npy", np.array(data, dtype=np.object_))
        return tmp_path / "clip"

    return edit


def test_a_hand_model_of_terabytes(tmp_path: Path) -> None:
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(sparse((1 << 40, 3)))
    with pytest.raises(InputError, match="a sparse matrix of shape"):
        load_hand_model(tmp_path, "right")


def test_honest_pickles_stay() -> None:
    """A clip of 2000 frames, a matrix as MANO's, and parts that are shared a few times."""
    eye = np.eye(4)
    data = {
        "cameras": {f"world_mat_{t}": np.eye(4) + t for t in range(4000)},
        "same": [eye] * 4000,
        "names": [f"{t:05d}.jpg" for t in range(2000)],
        "poses": np.zeros((2000, 48)),
        "rows": [[float(i)] * 48 for i in range(2000)],
        "matrix": scipy.sparse.csc_matrix(np.eye(16, 778)),
        ("a", ("b", 1)): {1, 2, (3, 4)},
    }
    back = restricted_load(io.BytesIO(pickle.dumps(data, 4)), name="file.pkl", allow=ALLOW)
    assert back.keys() == data.keys()
    np.testing.assert_array_equal(back["cameras"]["world_mat_7"], np.eye(4) + 7)
    np.testing.assert_array_equal(back["matrix"].toarray(), np.eye(16, 778))
    assert back["rows"] == data["rows"]

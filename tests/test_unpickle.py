"""The restricted unpickler: what it must read, and what it must never run."""

import builtins
import collections
import io
import os
import pickle
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import torch

from bigs.checks import InputError
from bigs.unpickle import ARRAYS, CHUMPY, SPARSE, TENSORS, load_npy, restricted_load

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)


def round_trip(value: Any, protocol: int = 4, allow: frozenset[tuple[str, str]] = CHUMPY | TENSORS) -> Any:
    return restricted_load(io.BytesIO(pickle.dumps(value, protocol)), name="file.pkl", allow=allow)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(
    "array",
    [
        np.arange(12.0).reshape(3, 4),
        np.asfortranarray(np.arange(12).reshape(3, 4)),
        np.arange(24, dtype=">i2").reshape(2, 3, 4).transpose(1, 0, 2),
        np.array([True, False]),
        np.array(["ab", "c"]),
        np.array(b"xyz"),
        np.zeros((0, 3), np.float16),
        np.array(2.5),
        np.float32(2.5),
        np.int64(-3),
    ],
    ids=lambda a: f"{a.dtype}-{a.shape}",
)
def test_arrays_come_back(array: np.ndarray, protocol: int) -> None:
    back = round_trip(array, protocol, ARRAYS)
    assert type(back) is type(array)
    assert back.dtype == array.dtype
    np.testing.assert_array_equal(back, array)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_containers_come_back(protocol: int) -> None:
    value = {"a": [1, (2.5, None)], "b": {True}, 3: frozenset({"x"}), "c": b"\xff\x00", "d": b"", "e": "é"}
    assert round_trip(value, protocol, ARRAYS) == value
    ordered = round_trip(collections.OrderedDict(one=np.arange(2), two=[1]), protocol, ARRAYS)
    assert list(ordered) == ["one", "two"]
    assert ordered["one"].tolist() == [0, 1]


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_sparse_matrices_come_back(protocol: int) -> None:
    dense = np.array([[0.0, 2, 0], [1, 0, 3]])
    for make in (scipy.sparse.csc_matrix, scipy.sparse.csr_matrix, scipy.sparse.csc_array):
        back = round_trip(make(dense), protocol, SPARSE)
        assert isinstance(back, make)
        np.testing.assert_array_equal(back.toarray(), dense)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64, torch.uint8, torch.bool])
def test_tensors_come_back(protocol: int, dtype: torch.dtype) -> None:
    tensor = torch.arange(24).reshape(4, 6).to(dtype)
    # A slice keeps its whole storage; a transpose keeps its strides.
    for part in (tensor, tensor[1:3, 2:], tensor.t(), tensor[0, 0], tensor[:0]):
        back = round_trip({"x": part}, protocol, TENSORS)["x"]
        assert back.dtype == dtype
        assert torch.equal(back, part)


def test_tensors_are_only_read_where_they_are_expected() -> None:
    with pytest.raises(InputError, match="torch"):
        round_trip(torch.zeros(3), 4, ARRAYS)


def test_shared_parts_stay_shared_and_cycles_are_refused() -> None:
    part = np.arange(3)
    back = round_trip([part, part])
    assert back[0] is back[1]
    cycle: list[Any] = []
    cycle.append(cycle)
    with pytest.raises(InputError, match="contains itself"):
        round_trip(cycle)


class Call:
    """Pickles as a call of `function`."""

    def __init__(self, function: Any, *args: Any, state: Any = None) -> None:
        self.reduced = (function, args) if state is None else (function, args, state)

    def __reduce__(self) -> tuple[Any, ...]:
        return self.reduced


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(
    ("function", "args", "named"),
    [
        (os.system, ("exit 1",), "system"),
        (builtins.eval, ("1/0",), "eval"),
        (builtins.exec, ("raise SystemExit",), "exec"),
        (builtins.getattr, ("a", "upper"), "getattr"),
        (subprocess.Popen, (["false"],), "Popen"),
        (np.load, ("file.npy",), "load"),
        (np.memmap, ("file.npy",), "memmap"),
        (torch.load, ("file.pt",), "load"),
        (pickle.loads, (b"",), "loads"),
        (bytearray, (10,), "bytearray"),
    ],
)
@pytest.mark.parametrize(
    "nest", [lambda x: x, lambda x: {"a": [(x,)]}, lambda x: np.array([x], dtype=object)]
)
def test_code_is_refused_by_name(
    protocol: int, function: Any, args: tuple[Any, ...], named: str, nest: Any
) -> None:
    with pytest.raises(InputError) as caught:
        round_trip(nest(Call(function, *args)), protocol)
    assert "file.pkl" in str(caught.value)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_dotted_name_does_not_reach_through_an_allowed_one() -> None:
    raw = pickle.PROTO + b"\x04" + b"\x8c\x05numpy\x8c\x10ndarray.__init__\x93."
    with pytest.raises(InputError, match=r"ndarray\.__init__"):
        restricted_load(io.BytesIO(raw), name="file.pkl", allow=CHUMPY | TENSORS)


@pytest.mark.parametrize(
    "value",
    [
        np.zeros(2, dtype=[("a", "f8"), ("b", "O")]),
        np.ma.array([1.0]),
        np.zeros(2, "M8[s]"),
        Call(np.dtype, "f8", state=(3, "|", None, ("a",), {"a": 1}, 8, 1, 0)),
        Call(np.dtype, "O8", state=(3, "|", (np.dtype("f8"), (2,)), None, None, 8, 1, 0)),
        np.ndarray,
        object(),
        Call(np.ndarray, (10,)),
        slice(3),
        2**70 * 1j,
    ],
    # Not their representations: addresses differ from process to process, and with them the tests' names.
    ids=[
        "array-with-objects",
        "masked-array",
        "dates",
        "dtype-with-objects",
        "dtype-of-objects-in-disguise",
        "class",
        "object",
        "array-made-by-hand",
        "slice",
        "complex",
    ],
)
def test_what_is_not_plain_data_is_refused(value: Any) -> None:
    with pytest.raises(InputError, match=r"file\.pkl"):
        round_trip(value)


def forged_array(dtype: np.dtype, shape: tuple[int, ...], data: Any) -> Call:
    reconstruct = np.zeros(0).__reduce__()[0]
    return Call(reconstruct, np.ndarray, (0,), b"b", state=(1, shape, dtype, False, data))


@pytest.mark.parametrize(
    ("dtype", "shape", "data"),
    [
        (np.dtype("f8"), (1000,), b"\0" * 8),
        (np.dtype("f8"), (-1,), b"\0" * 8),
        (np.dtype("f8"), (2,), [1.0, 2.0]),
        (np.dtype(object), (1,), b"\x41" * 8),
        (np.dtype(object), (3,), [1]),
        (np.dtype("f8"), "ab", b"\0" * 8),
    ],
)
def test_forged_arrays_are_refused(dtype: np.dtype, shape: Any, data: Any) -> None:
    """Raw bytes in place of object pointers, or a shape larger than the data, would be read out of bounds."""
    with pytest.raises(InputError):
        round_trip(forged_array(dtype, shape, data))


def test_forged_object_dtype_does_not_turn_bytes_into_pointers() -> None:
    plain = Call(np.dtype, "O8", False, True, state=(3, "|", None, None, None, -1, -1, 0))
    with pytest.raises(InputError):
        round_trip(forged_array(plain, (1,), b"\x41" * 8))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("indices", "indptr"), [([99], [0, 1, 1, 1]), ([0], [0, 1, 1, 5]), ([-7], [0, 1, 1, 1])]
)
def test_forged_sparse_indices_are_refused(indices: list[int], indptr: list[int]) -> None:
    matrix = scipy.sparse.csc_matrix(np.eye(3))
    matrix.data, matrix.indices = np.ones(1), np.array(indices, np.int32)
    matrix.indptr = np.array(indptr, np.int32)
    with pytest.raises(InputError):
        round_trip(matrix)


@pytest.mark.parametrize(
    ("offset", "size", "stride"),
    [(0, (1000,), (1,)), (5, (3,), (1,)), (-1, (1,), (1,)), (0, (2,), (100,)), (0, (10**9,), (0,))],
)
def test_forged_tensor_views_are_refused(offset: int, size: Any, stride: Any) -> None:
    storage = torch.zeros(6).__reduce_ex__(2)[1][0]
    call = Call(
        torch._utils._rebuild_tensor_v2, storage, offset, size, stride, False, collections.OrderedDict()
    )
    with pytest.raises(InputError):
        round_trip(call)


def test_a_few_bytes_cannot_demand_gigabytes() -> None:
    for raw in (
        b"\x80\x02Nr\xff\xff\xff\x7f.",  # memo slot 2**31 - 1
        b"\x80\x05\x96" + (2**40).to_bytes(8, "little") + b"x.",  # a bytearray of a terabyte
        b"\x80\x04\x8e" + (2**40).to_bytes(8, "little") + b"x.",
    ):
        with pytest.raises(InputError):
            restricted_load(io.BytesIO(raw), name="file.pkl")


def test_damaged_pickles_give_input_errors_only() -> None:
    value = {
        "a": np.arange(10),
        "t": torch.zeros(3),
        "o": np.array([{"a": 1}], object),
        "s": scipy.sparse.eye(3, format="csc"),
    }
    rng = np.random.default_rng(0)
    for protocol in (2, 5):
        raw = pickle.dumps(value, protocol)
        for _ in range(400):
            damaged = bytearray(raw[: rng.integers(1, len(raw) + 1)])
            for position in rng.integers(0, len(damaged), 2):
                damaged[position] = rng.integers(256)
            try:
                restricted_load(io.BytesIO(bytes(damaged)), name="file.pkl", allow=CHUMPY | TENSORS)
            except InputError as error:
                assert str(error).startswith("file.pkl: ")


def test_npy_of_an_object_gives_the_object(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", {"x": torch.eye(4), "y": np.arange(3)}, allow_pickle=True)
    loaded = load_npy(tmp_path / "a.npy")
    assert torch.equal(loaded["x"], torch.eye(4))
    np.save(tmp_path / "b.npy", np.arange(6.0).reshape(2, 3))
    np.testing.assert_array_equal(load_npy(tmp_path / "b.npy"), np.arange(6.0).reshape(2, 3))
    np.save(tmp_path / "c.npy", np.array([None, {"a": 1}], dtype=object), allow_pickle=True)
    assert load_npy(tmp_path / "c.npy").tolist() == [None, {"a": 1}]


def test_npy_errors_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "data.npy"
    with pytest.raises(InputError, match=r"data\.npy: expected an \.npy file, found no such file"):
        load_npy(path)
    path.write_text("not an array, but long enough for a header" * 5)
    with pytest.raises(InputError, match=r"data\.npy"):
        load_npy(path)
    np.save(path, np.array({"x": Call(os.system, "exit 1")}, dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match=r"data\.npy.*system"):
        load_npy(path)
    np.save(path, np.arange(100))
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(InputError, match=r"data\.npy"):
        load_npy(path)
    np.save(path, np.zeros(2, dtype=[("a", "O")]), allow_pickle=True)
    with pytest.raises(InputError, match="dtype"):
        load_npy(path)

"""Files of torch: read as torch reads them, and refused before much is made of little."""

from __future__ import annotations

import io
import pickle
import time
import tracemalloc
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from bigs.checks import InputError
from bigs.export.challenge import load_challenge
from bigs.export.submission import check_submission
from bigs.torch_files import load_torch
from bigs.weights import load_weights

MIB = 1 << 20
DTYPES = (
    torch.float64,
    torch.float32,
    torch.float16,
    torch.bfloat16,
    torch.int64,
    torch.int32,
    torch.int16,
    torch.int8,
    torch.uint8,
    torch.bool,
)


def saved(value: Any, **options: Any) -> bytes:
    stream = io.BytesIO()
    torch.save(value, stream, **options)
    return stream.getvalue()


def read(content: bytes) -> Any:
    return load_torch("file.pt", io.BytesIO(content), "tensors")


def changed(content: bytes, change: dict[str, Any], method: int = zipfile.ZIP_STORED) -> bytes:
    """A file of torch with some members replaced."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(stream, "w", method) as new:
        for name in old.namelist():
            new.writestr(name, change.get(name.partition("/")[2], old.read(name)))
    return stream.getvalue()


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_what_torch_saves_is_read_as_torch_reads_it(zipped: bool, dtype: torch.dtype) -> None:
    base = torch.arange(24).to(dtype).reshape(2, 3, 4)
    value = {
        "whole": base,
        "turned": base.transpose(0, 2),
        "part": base[1, :, 1:3],
        "alone": base[0, 0, 1],
        "none": base[:0],
        "layer": OrderedDict(weight=base.flatten()[3:], again=[base, (1, "two", None, 0.5)]),
    }
    if dtype.is_floating_point:
        value["parameter"] = torch.nn.Parameter(base.clone())
    content = saved(value, _use_new_zipfile_serialization=zipped)
    found, expected = read(content), torch.load(io.BytesIO(content), weights_only=True)
    assert set(found) == set(expected)
    for key in ("whole", "turned", "part", "alone", "none"):
        assert found[key].dtype == dtype and torch.equal(found[key], expected[key])
    assert torch.equal(found["layer"]["weight"], base.flatten()[3:])
    assert torch.equal(found["layer"]["again"][0], base) and found["layer"]["again"][1] == (
        1,
        "two",
        None,
        0.5,
    )


@pytest.mark.parametrize("zipped", [True, False])
def test_networks_are_read(zipped: bool) -> None:
    network = torch.nn.Sequential(torch.nn.Conv2d(3, 8, 3), torch.nn.BatchNorm2d(8))
    found = read(saved(network.state_dict(), _use_new_zipfile_serialization=zipped))
    assert found.keys() == network.state_dict().keys()
    assert all(torch.equal(found[name], value) for name, value in network.state_dict().items())


def tensor_program(size: bytes, stride: bytes, count: bytes = b"K\x01") -> bytes:
    """A pickle of a tensor in a storage that is said to have `count` float32 values."""
    storage = (
        b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpu"
        + count
        + b"tQ"
    )
    return b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(" + storage + b"K\x00" + size + stride + b"\x89}tR."


def shared_tuple(levels: int) -> Any:
    value: Any = 1
    for _ in range(levels):
        value = (value, value)
    return value


HUGE = pickle.dumps(1 << 40, 2)[2:-1]
WHOLE = saved(torch.zeros(1))
# Made when a test reads them: some pack hundreds of megabytes.
HOSTILE: dict[str, Callable[[], bytes]] = {
    "shared tuple as a key": lambda: changed(
        WHOLE, {"data.pkl": b"\x80\x02}" + pickle.dumps(shared_tuple(40), 2)[2:-1] + b"K\x01s."}
    ),
    "a buffer of any length": lambda: changed(
        WHOLE, {"data.pkl": b"\x80\x02c__builtin__\nbytearray\n" + HUGE + b"\x85R."}
    ),
    "bytes of any length": lambda: changed(
        WHOLE, {"data.pkl": b"\x80\x02c__builtin__\nbytes\n" + HUGE + b"\x85R."}
    ),
    "a packed member": lambda: changed(WHOLE, {"data/0": bytes(200 * MIB)}, zipfile.ZIP_DEFLATED),
    "a stride of zero": lambda: changed(WHOLE, {"data.pkl": tensor_program(HUGE + b"\x85", b"K\x00\x85")}),
    "a storage that is cut": lambda: changed(
        WHOLE, {"data.pkl": tensor_program(b"K\x01\x85", b"K\x01\x85", HUGE)}
    ),
    "a storage that is longer": lambda: changed(WHOLE, {"data/0": bytes(8)}),
    "a tensor beyond its storage": lambda: changed(
        WHOLE,
        {"data.pkl": tensor_program(b"K\x01K\x01\x86", b"K\x07K\x07\x86").replace(b"tQK\x00", b"tQK\x05")},
    ),
    "a tensor many times": lambda: changed(
        saved(torch.zeros(MIB)),
        {
            "data.pkl": b"\x80\x02("
            + 100 * tensor_program(b"J\xff\xff\x0f\x00\x85", b"K\x01\x85", b"J\x00\x00\x10\x00")[2:-1]
            + b"t."
        },
    ),
    "code": lambda: saved({"a": print}),
    "another order": lambda: changed(WHOLE, {"byteorder": b"big"}),
    "no program": lambda: changed(WHOLE, {}).replace(b"data.pkl", b"nothing!"),
    "old, whose length is another": lambda: saved(torch.zeros(1), _use_new_zipfile_serialization=False)[:-2],
    "old, whose program is deep": lambda: (
        saved(0, _use_new_zipfile_serialization=False)[:-14] + b"\x80\x02" + b"]" * 10**5
    ),
    "text": lambda: b"hello",
    "nothing": lambda: b"",
}


@pytest.mark.parametrize("what", HOSTILE)
def test_little_that_asks_for_much(what: str) -> None:
    content = HOSTILE[what]()
    began = time.process_time()
    tracemalloc.start()
    with pytest.raises(InputError, match=r"^file\.pt: expected .*found") as caught:
        read(content)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(str(caught.value).splitlines()) == 1 and len(str(caught.value)) < 400
    assert peak < 64 * MIB and time.process_time() - began < 5


def test_every_reader_refuses_them(tmp_path: Path) -> None:
    """A prediction, a submission's member and the weights of a network."""
    content = HOSTILE["shared tuple as a key"]()
    for reader in (load_challenge, lambda path: load_weights(path, "VGG-16")):
        path = tmp_path / "file.pt"
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"file\.pt: expected"):
            reader(path)
    with zipfile.ZipFile(tmp_path / "preds.zip", "w") as archive:
        archive.writestr("arctic_preds/one.pt", content)
    with pytest.raises(InputError, match=r"one\.pt: expected"):
        check_submission(tmp_path / "preds.zip", ["one"])

"""What stands where a file is expected, and files that announce or unfold to more than they may."""

from __future__ import annotations

import io
import os
import struct
import time
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bigs import archives
from bigs.archives import MAX_MEMBERS, read_npz
from bigs.checks import InputError, shown
from bigs.commands.batch.manifest import read_manifest
from bigs.data.formats.transforms import read_cameras
from bigs.export.ply import load_splats
from bigs.export.poses import load_poses
from bigs.files import MAX_DEPTH, MAX_YAML_BYTES, MAX_YAML_NODES, open_regular, read_json, read_yaml
from bigs.hand.io import load_hand_model
from bigs.models.playback_file import load_playback
from bigs.train.plan.config_file import load_config, with_changes
from bigs.train.plan.presets import PRESETS
from bigs.unpickle import load_npy
from bigs.weights import load_weights


@contextmanager
def little(most: int = 32 << 20, seconds: float = 5.0) -> Iterator[None]:
    """Whatever happens inside takes little memory and time."""
    tracemalloc.start()
    began = time.process_time()
    try:
        yield
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < most
    assert time.process_time() - began < seconds


READERS: dict[str, Callable[[Path], object]] = {
    "x.json": read_json,
    "transforms.json": read_cameras,
    "config.yaml": load_config,
    "clips.yaml": read_manifest,
    "clips.csv": read_manifest,
    "clips.txt": read_manifest,
    "gt.npz": lambda path: read_npz(path, "ground truth"),
    "poses.npz": load_poses,
    "MANO_RIGHT.npz": lambda path: load_hand_model(path, "right"),
    "MANO_RIGHT.pkl": lambda path: load_hand_model(path, "right"),
    "data.npy": load_npy,
    "splats.ply": load_splats,
    "scene.safetensors": load_playback,
    "vgg.pth": lambda path: load_weights(path, "VGG-16"),
}


@pytest.mark.parametrize("name", READERS)
def test_what_is_no_regular_file(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    places: list[tuple[str, Callable[[], object]]] = [
        ("nothing|no such file", lambda: None),
        ("a folder|nothing|neither", path.mkdir),
        ("a pipe|nothing", lambda: os.mkfifo(path)),
        ("a device|nothing", lambda: path.symlink_to("/dev/zero")),
    ]
    for found, make in places:
        make()
        with pytest.raises(InputError, match=f"^{path}: expected .*found ({found})"):
            READERS[name](path)
        path.rmdir() if path.is_dir() else path.unlink(missing_ok=True)


def test_a_file_that_is_too_large(tmp_path: Path) -> None:
    path = tmp_path / "large.json"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # takes no place on the disk
    with little(), pytest.raises(InputError, match=r"expected a JSON file of at most \d+ bytes, found 1099"):
        read_json(path)
    with pytest.raises(InputError, match=f"at most {MAX_YAML_BYTES} bytes"):
        read_yaml(path)
    with open_regular(path, "anything", 1 << 40) as file:
        assert file.read(2) == b"\0\0"


def test_paths_that_no_system_takes(tmp_path: Path) -> None:
    for path in (f"{tmp_path}/a\0b", f"{tmp_path}/{'n' * 300}", f"{tmp_path}/\ud800"):
        with pytest.raises(InputError, match="expected a thing, found"):
            open_regular(path, "a thing")


# --- documents ---


def laughs(levels: int, each: int = 10) -> str:
    """YAML of a few hundred letters with each ** levels values."""
    lines = ["a0: &a0 x"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * each)}]" for i in range(1, levels)]
    return "\n".join(lines) + "\n"


def merges(levels: int) -> str:
    lines = ["a0: &a0 {k: v}"]
    lines += [f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}], k{i}: v}}" for i in range(1, levels)]
    return "\n".join(lines) + "\n"


HOSTILE_YAML = {
    "laughs": (laughs(12), f"at most {MAX_YAML_NODES} values with its aliases"),
    "deep aliases": (laughs(45, each=1), f"at most {MAX_DEPTH} levels|"),
    "merges": (merges(40), f"at most {MAX_YAML_NODES} values with its aliases"),
    # Newer parsers have a limit of their own.
    "deep": ("[" * 100_000, "levels|maximum nesting depth"),
    "deep mapping": ("".join(" " * i + "a:\n" for i in range(200)), "levels"),
    "itself": ("a: &a [*a]", "expected aliases after their anchors"),
    "digits": (f"a: {'9' * 5000}", "expected YAML, found|digits"),
    "400 digits": (f"a: {'9' * 400}", "numbers of at most 100 digits, found an integer of"),
    "hexadecimal": (f"a: 0x{'f' * 100_000}", "numbers of at most 100 digits"),
    "a date": ("a: 2001-99-99", "expected YAML, found"),
    "object": ("!!python/object/apply:os.system [ls]", "expected YAML, found"),
    "list as a key": ("? [a, b]\n: c", "expected YAML, found"),
    "NUL": ("a: \0", "expected YAML, found"),
    "half a file": ("a: [", "expected YAML, found"),
}


@pytest.mark.parametrize("how", HOSTILE_YAML)
@pytest.mark.parametrize("name", ["config.yaml", "clips.yaml"])
def test_hostile_yaml(how: str, name: str, tmp_path: Path) -> None:
    text, words = HOSTILE_YAML[how]
    path = tmp_path / name
    path.write_text(text)
    with little(64 << 20), pytest.raises(InputError, match=rf"{name}: .*({words})") as refusal:
        READERS[name](path)
    assert len(str(refusal.value)) < 500


def test_hostile_settings() -> None:
    for text in ("[" * 1000, f"[{'[' * 60}{']' * 60}]", "&a [*a]", "9" * 5000):
        with little(), pytest.raises(InputError, match=r"^--set seed=") as refusal:
            with_changes(PRESETS["smoke"], [f"seed={text}"])
        assert len(str(refusal.value)) < 12_000


def test_honest_aliases_stay(tmp_path: Path) -> None:
    path = tmp_path / "clips.yaml"
    path.write_text("defaults: &d {preset: fast}\nclips:\n- {<<: *d, clip: a}\n- {<<: *d, clip: b}\n")
    assert [entry.preset for entry in read_manifest(path)] == ["fast", "fast"]


HOSTILE_JSON = {
    "deep": ("[" * 100_000, "levels"),
    "deep and closed": ("[" * 200 + "]" * 200, "levels"),
    "deep mappings": ('{"a":' * 300 + "1" + "}" * 300, "levels"),
    "5000 digits": ("9" * 5000, "expected JSON, found"),
    "400 digits": ("[" + "9" * 400 + "]", "digits, found an integer of"),
    "half a file": ("[1, 2", "expected JSON, found"),
    "nothing": ("", "expected JSON, found"),
}


@pytest.mark.parametrize("how", HOSTILE_JSON)
def test_hostile_json(how: str, tmp_path: Path) -> None:
    text, words = HOSTILE_JSON[how]
    path = tmp_path / "x.json"
    path.write_text(text)
    with little(), pytest.raises(InputError, match=f"x.json: .*{words}") as refusal:
        read_json(path)
    assert len(str(refusal.value)) < 300


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(b'{"a": "\xff"}')
    with pytest.raises(InputError, match="text in UTF-8, found other bytes"):
        read_json(path)


def test_brief_shows_a_little_of_anything() -> None:
    shared: Any = ["x" * 1000]
    for _ in range(200):
        shared = (shared, shared)
    with little():
        for value in (
            shared,
            {"a": shared},
            10**5000,
            "\ud800" * 1000,
            b"\0" * 10**6,
            np.zeros(10**6),
            object(),
        ):
            assert len(shown(value)) <= 80
    assert shown([1, "a", None]) == "[1, 'a', None]"


# --- archives ---


def npy(shape: object, dtype: str = "<f8", data: bytes = b"") -> bytes:
    """An .npy file whose header announces whatever it likes."""
    text = f"{{'descr': {dtype!r}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def zipped(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


@pytest.mark.parametrize("text", [b"{", b"{'descr': (", b'"""', b"[" * 5000, b"\\", b"{'descr': 1}"])
def test_headers_that_are_no_python(tmp_path: Path, text: bytes) -> None:
    header = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text
    path = zipped(tmp_path / "gt.npz", {"K.npy": header})
    with pytest.raises(InputError, match=r"gt.npz: 'K': expected an .npy array, found"):
        read_npz(path, "ground truth")


@pytest.mark.parametrize("name", ["gt.npz", "poses.npz", "MANO_RIGHT.npz"])
def test_archives_that_unpack_to_too_much(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert archives.MAX_UNPACKED_BYTES < 1 << 29
    monkeypatch.setattr(archives, "MAX_UNPACKED_BYTES", 4 << 20)
    path = zipped(tmp_path / name, {f"{i}.npy": bytes(1 << 20) for i in range(5)})
    with little(4 << 20), pytest.raises(InputError, match=rf"{name}: expected an archive that unpacks to at"):
        READERS[name](path)


def test_an_archive_that_understates_its_size(tmp_path: Path) -> None:
    path = zipped(tmp_path / "gt.npz", {"K.npy": npy((3, 3), data=bytes(64 << 20))})
    content = path.read_bytes()
    size = struct.pack("<I", len(npy((3, 3))) + (64 << 20))
    assert content.count(size) >= 1
    path.write_bytes(content.replace(size, struct.pack("<I", 1000)))
    with little(), pytest.raises(InputError, match=r"gt.npz: .*damaged"):
        read_npz(path, "ground truth")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_compressions_that_unpack_without_bound(method: int, tmp_path: Path) -> None:
    path = zipped(tmp_path / "gt.npz", {"K.npy": bytes(1000)}, method)
    with pytest.raises(InputError, match=r"'K.npy': expected a stored or deflated member, found compression"):
        read_npz(path, "ground truth")


def test_too_many_members(tmp_path: Path) -> None:
    path = zipped(tmp_path / "gt.npz", {f"{i}.npy": b"" for i in range(MAX_MEMBERS + 1)}, zipfile.ZIP_STORED)
    with pytest.raises(InputError, match=f"expected at most {MAX_MEMBERS} members"):
        read_npz(path, "ground truth")


HOSTILE_ARRAYS = {
    "terabytes": npy((10**6, 10**6)),
    "beyond 64 bits": npy((2**40, 2**40, 2**40)),
    "long text": npy((10**3,), f"<U{10**6}"),
    "negative": npy((-5, 3), data=bytes(120)),
    "one too many": npy((4,), data=bytes(24)),
    "deep literal": npy("(" * 3000 + ")" * 3000),
    "objects": npy((3,), "|O", bytes(24)),
    "another version": b"\x93NUMPY\x07\x00" + npy((1,))[8:],
}


@pytest.mark.parametrize("how", HOSTILE_ARRAYS)
def test_arrays_that_announce_more_than_there_is(how: str, tmp_path: Path) -> None:
    content = HOSTILE_ARRAYS[how]
    file = zipped(tmp_path / "gt.npz", {"K.npy": content})
    with little(), pytest.raises(InputError, match=r"gt.npz: 'K': expected"):
        read_npz(file, "ground truth")
    (tmp_path / "data.npy").write_bytes(content)
    with little(), pytest.raises(InputError, match=r"data.npy: expected"):
        load_npy(tmp_path / "data.npy")


def test_honest_archives_stay(tmp_path: Path) -> None:
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.eye(3)), "c": np.array("text")}
    still = np.zeros((1200, 778, 3))  # a hand that never moves shrinks a thousandfold
    np.savez_compressed(tmp_path / "gt.npz", still=still, **arrays)
    found = read_npz(tmp_path / "gt.npz", "ground truth")
    assert found.keys() == {*arrays, "still"}
    for key, array in arrays.items():
        np.testing.assert_array_equal(found[key], array)
    assert read_npz(tmp_path / "gt.npz", "ground truth", ["a"]).keys() == {"a"}
    buffer = io.BytesIO()
    np.save(buffer, arrays["a"])
    (tmp_path / "plain.npy").write_bytes(buffer.getvalue())
    np.testing.assert_array_equal(load_npy(tmp_path / "plain.npy"), arrays["a"])

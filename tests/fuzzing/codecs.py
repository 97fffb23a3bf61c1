"""Kinds of files, each read as a tree, changed there and written again."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import pickle
import random
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from PIL import Image
from safetensors.numpy import load_file, save

from .hostile import Raw, array, number, python_value, text, text_value
from .trees import change_tree

Change = Callable[[random.Random, Path], None]


def change_json(rng: random.Random, path: Path) -> None:
    path.write_text(json_text(change_tree(rng, json.loads(path.read_text()), text_value)))


def change_yaml(rng: random.Random, path: Path) -> None:
    """Written as JSON, which is YAML, or as what JSON has not: aliases, tags, dates, several documents."""
    tree = yaml.safe_load(path.read_text())
    if rng.random() < 0.85:
        path.write_text(json_text(change_tree(rng, tree, _yaml_value)))
        return
    lines = path.read_text().splitlines()
    at = rng.randrange(len(lines) + 1)
    lines[at:at] = [
        rng.choice(("---", "%YAML 9.9", "\t", "- x", "? x", "<<: {a: 1}", "a: &a [*a]", "...", "!!x y: 1"))
    ]
    path.write_text("\n".join(lines))


def _yaml_value(rng: random.Random) -> Any:
    if rng.random() < 0.7:
        return text_value(rng)
    levels = rng.choice((3, 9, 30))
    bomb = "[&a0 [x, x]" + "".join(f", &a{i + 1} [*a{i}, *a{i}]" for i in range(levels)) + f", *a{levels}]"
    keys = "{&b0 {x: 1}: 1" + "".join(f", &b{i + 1} {{*b{i} : 1}}: 1" for i in range(levels)) + "}"
    return Raw(
        rng.choice(
            (
                bomb,
                keys,
                "&a [*a]",
                "&a {x: *a}",
                "!!python/object/apply:os.system [id]",
                "!!binary aGk=",
                "!!set {1, 2}",
                "!!timestamp 2000-01-01",
                "2000-01-01",
                "!!int 1_000:59",
                "0b1",
                ".nan",
                "-.inf",
                "1e400",
                "~",
                "*unknown",
                "{? [1, 2] : 3}",
                "1:2:3",
            )
        )
    )


def json_text(value: Any) -> str:
    """JSON as a hand might write it: NaN and surrogates included, raw text as it is."""
    if isinstance(value, Raw):
        return str(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(str(k))}: {json_text(v)}" for k, v in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(json_text, value)) + "]"
    return json.dumps(value)


def change_csv(rng: random.Random, path: Path) -> None:
    rows = list(csv.reader(path.read_text().splitlines()))
    cells = change_tree(
        rng, rows, lambda r: r.choice((str(number(r)), text(r), "x" * 200_000, '"', "\n", ",,,"))
    )
    buffer = io.StringIO()
    for row in cells if isinstance(cells, list) else [cells]:
        csv.writer(buffer).writerow(row if isinstance(row, list) else [row])
    path.write_text(buffer.getvalue(), errors="surrogatepass")


def change_words(rng: random.Random, path: Path) -> None:
    """Files of lines of words: COLMAP's text, OBJ, PLY, lists."""
    head, separator, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split(" ") for line in head.decode("latin-1").split("\n")]
    lines = change_tree(
        rng, lines, lambda r: r.choice((str(number(r)), text(r), "9" * 400, "-1", "4294967295"))
    )
    if isinstance(lines, list):
        joined = "\n".join(
            " ".join(map(str, line)) if isinstance(line, list) else str(line) for line in lines
        )
    else:
        joined = str(lines)
    path.write_bytes(joined.encode("utf-8", "surrogatepass") + separator + body)


def change_npz(rng: random.Random, path: Path) -> None:
    with np.load(path, allow_pickle=True) as stored:
        tree = {key: stored[key] for key in stored.files}
    changed = _mapping(change_tree(rng, tree, python_value))
    members = {str(key): _npy(rng, value) for key, value in changed.items()}
    if rng.random() < 0.06:
        members[rng.choice(list(members) or ["x"])] = _forged_npy(rng)
    _write_zip(rng, path, {f"{key}.npy": content for key, content in members.items()})


def change_npy(rng: random.Random, path: Path) -> None:
    """An array that holds one dictionary, or numbers."""
    if rng.random() < 0.04:
        path.write_bytes(_forged_npy(rng))
        return
    stored = np.load(path, allow_pickle=True)
    if stored.dtype == np.object_ and stored.ndim == 0:
        tree = change_tree(rng, stored.item(), python_value)
        held = np.empty((), dtype=np.object_)
        held[()] = tree
        path.write_bytes(_npy(rng, held if rng.random() < 0.95 else tree))
    else:
        path.write_bytes(_npy(rng, change_tree(rng, stored, python_value)))


def change_pickle(rng: random.Random, path: Path) -> None:
    tree = change_tree(rng, pickle.loads(path.read_bytes()), python_value)
    path.write_bytes(pickle.dumps(tree, protocol=rng.choice((2, 2, 4))))


def change_safetensors(rng: random.Random, path: Path) -> None:
    """The tensors, what is said beside them, or the header itself."""
    content = path.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + length])
    metadata = header.pop("__metadata__", None)
    if metadata and rng.random() < 0.9:
        # As an earlier version wrote it: a checksum would tell every change before it is met.
        facts = json.loads(metadata["bigs"])
        facts.pop("checksum", None)
        metadata = {"bigs": json.dumps(facts | {"format": "bigs-scene-3"})}
    kind = rng.randrange(10)
    if kind < 5:
        tensors = {
            str(key): np.ascontiguousarray(value)
            for key, value in _mapping(change_tree(rng, load_file(path), array)).items()
            if isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.dtype.isnative
        }
        path.write_bytes(save(tensors, metadata))
        return
    if metadata:
        header["__metadata__"] = metadata
    if kind < 8 and metadata:
        facts = {key: json.loads(value) for key, value in metadata.items()}
        facts = _mapping(change_tree(rng, facts, text_value))
        header["__metadata__"] = {
            key: value if isinstance(value, str) and rng.random() < 0.5 else json_text(value)
            for key, value in facts.items()
        }
    else:
        header = change_tree(rng, header, text_value)
    written = json_text(header).encode()
    path.write_bytes(struct.pack("<Q", len(written)) + written + content[8 + length :])


def change_torch(rng: random.Random, path: Path) -> None:
    path.write_bytes(_changed_torch(rng, path.read_bytes()))


def change_zip(rng: random.Random, path: Path) -> None:
    """A zip of predictions: its members, their names, or what one of them says."""
    with zipfile.ZipFile(path) as stored:
        members = {name: stored.read(name) for name in stored.namelist()}
    name = rng.choice(list(members))
    if rng.random() < 0.75:
        members[name] = _changed_torch(rng, members[name])
    elif rng.random() < 0.7:
        members[text(rng).replace("\ud800", "x")] = members.pop(name)
    else:
        members.pop(name)
    _write_zip(rng, path, members)


def change_numbers(rng: random.Random, path: Path) -> None:
    """Numbers somewhere in a binary file: counts, sizes, coordinates."""
    content = bytearray(path.read_bytes())
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = 4 * rng.randrange(min(len(content) // 4 - 1, rng.choice((8, 40, 10_000))))
        value = rng.choice(("d", "d", "Q", "I"))
        floats = (float("nan"), float("inf"), 0.0, -1.0, 1e30, -1e30, 1e-30, 1e300)
        counts = (0, 1, 2**31, 2**32 - 1, 10**6) + ((2**40, 2**63, 2**64 - 1) if value == "Q" else ())
        packed = struct.pack("<" + value, rng.choice(floats if value == "d" else counts))
        content[at : at + len(packed)] = packed
    path.write_bytes(content)


def change_picture(rng: random.Random, path: Path) -> None:
    """Another size, another mode, another format, other values."""
    picture = Image.open(path)
    picture.load()
    size = rng.choice(((1, 1), (20, 3000), (3000, 20), (65_500, 1), (9000, 9000), (64, 48), picture.size))
    match rng.randrange(4):
        case 0:
            picture = picture.resize(size, Image.Resampling.NEAREST)
        case 1:
            picture = picture.convert(rng.choice(("L", "RGB", "RGBA", "P", "1", "LA", "CMYK", "I", "F")))
        case 2:
            values = np.random.default_rng(rng.randrange(99)).integers(
                0, 256, np.asarray(picture).shape, np.uint8
            )
            picture = Image.fromarray(values)
        case 3:
            picture = Image.new("I;16", size, 40_000)
    kind = rng.choice(("PNG", "PNG", "JPEG", "GIF", "BMP", "TIFF", "WEBP", "EPS", "PDF", "ICO"))
    buffer = io.BytesIO()
    try:
        picture.save(buffer, kind)
    except (OSError, ValueError):
        picture.convert("L").resize((64, 48)).save(buffer, "PNG")
    path.write_bytes(buffer.getvalue())


def _mapping(tree: Any) -> dict[Any, Any]:
    return tree if isinstance(tree, dict) else {"x": tree}


def _npy(rng: random.Random, value: Any) -> bytes:
    values = np.empty((), dtype=np.object_)
    values[()] = value
    if isinstance(value, np.ndarray):
        values = value
    elif len(pickle.dumps(value)) < 50_000 and _count(value, 1000) < 1000:
        with contextlib.suppress(ValueError, OverflowError):
            values = np.array(value)
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, values, version=rng.choice(((1, 0), (2, 0), (3, 0))), allow_pickle=True)
    return buffer.getvalue()


def _count(value: Any, most: int) -> int:
    """How many things a value holds, in all its depth; not counted beyond `most`."""
    waiting, found = [value], 0
    while waiting and found < most:
        found += 1
        held = waiting.pop()
        if isinstance(held, dict):
            waiting += held.values()
        elif isinstance(held, (list, tuple, set, frozenset)):
            waiting += held
    return found


def _forged_npy(rng: random.Random) -> bytes:
    """A header that promises what does not follow, or more than fits."""
    shape = rng.choice(
        ("(10000000000000,)", "(100000, 100000)", "(-1,)", "(3,", "(2**99,)", "()", "None", "(1.5,)")
    )
    kind = rng.choice(("<f8", "|O", "<U1000000", "|V99999999", "x", "<f8,", "[('a', '<f8')]"))
    order = rng.choice(("True", "False", "1", "None"))
    header = f"{{'descr': {kind!r}, 'fortran_order': {order}, 'shape': {shape}, }}\n".encode()
    return (
        b"\x93NUMPY\x01\x00"
        + struct.pack("<H", len(header))
        + header
        + rng.randbytes(rng.choice((0, 8, 800)))
    )


def _write_zip(rng: random.Random, path: Path, members: dict[str, bytes]) -> None:
    if rng.random() < 0.05:
        members[rng.choice(list(members) or ["x.npy"])] = bytes(300_000_000)
    names = list(members)
    if names and rng.random() < 0.05:
        names.append(rng.choice(names))
    kind = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    packed = zipfile.ZIP_DEFLATED if any(len(content) > 1 << 24 for content in members.values()) else kind
    with zipfile.ZipFile(path, "w", packed) as archive:
        for name in names:
            if len(re.sub(r"\ud800", "", name)) == len(name):
                archive.writestr(zipfile.ZipInfo(name[:60_000]), members[name], compress_type=packed)


def _changed_torch(rng: random.Random, content: bytes) -> bytes:
    tree = torch.load(io.BytesIO(content), weights_only=True)
    plain = _each(tree, lambda v: v.numpy() if isinstance(v, torch.Tensor) else v)
    changed = change_tree(rng, plain, python_value)
    forced = rng.random() < 0.9
    buffer = io.BytesIO()
    torch.save(_each(changed, lambda v: _tensor(v) if forced else v), buffer)
    return buffer.getvalue()


def _tensor(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return value
    try:
        return torch.from_numpy(value.copy())
    except (TypeError, ValueError):
        return value


def _each(tree: Any, change: Callable[[Any], Any]) -> Any:
    """Dictionaries and short lists are followed; what lies deeper is a value."""
    if isinstance(tree, dict):
        return {
            key: _each(value, change) if isinstance(value, dict) else change(value)
            for key, value in tree.items()
        }
    return change(tree)

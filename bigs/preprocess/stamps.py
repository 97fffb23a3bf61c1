"""Stamps of preprocessing artefacts: which are up to date.

Every artefact names its format's `version` and a digest of its `inputs`. A step whose artefact carries the
digest that its inputs have now is skipped; one whose inputs changed is done again. An artefact without a
digest was supplied by another tool and is kept as it is.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bigs.archives import read_npz
from bigs.atomic import atomic_write
from bigs.data.entries import mapping_entry
from bigs.files import read_json

VERSION = 1

State = Literal["missing", "current", "outdated", "supplied"]


def content_digest(*parts: Any) -> str:
    """A digest of a step's inputs.

    Args:
        parts: a path stands for its content (a folder for the names and contents of its files, a missing one
            for its absence), anything else for itself as JSON.
    """
    found = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path):
            _add_path(found, part)
        else:
            found.update(b"json" + json.dumps(part, sort_keys=True, default=_plain).encode() + b"\0")
    return found.hexdigest()


def state_of(path: Path, inputs: str) -> State:
    """Whether the artefact `path` (.json or .npz) has to be made.

    Args:
        path: the file that carries the stamp.
        inputs: the `content_digest` of what the step would read now.

    Raises:
        InputError: the file is damaged.
    """
    if not path.is_file():
        return "missing"
    stored = (
        read_stamped_json(path) if path.suffix == ".json" else read_stamped_npz(path, ("version", "inputs"))
    )
    if not str(stored.get("inputs", "")):
        return "supplied"
    # As text, whatever the value is.
    current = str(stored.get("version")) == str(VERSION) and str(stored["inputs"]) == inputs
    return "current" if current else "outdated"


def write_npz(path: Path, arrays: Mapping[str, Any], inputs: str) -> None:
    """Write arrays with their stamp; the file is whole or absent."""
    with atomic_write(path) as file:
        np.savez_compressed(file, version=np.int64(VERSION), inputs=np.str_(inputs), **arrays)


def write_json(path: Path, values: Mapping[str, Any], inputs: str) -> None:
    """Write values with their stamp as JSON; the file is whole or absent."""
    text = json.dumps({"version": VERSION, "inputs": inputs, **values}, indent=1, default=_plain)
    with atomic_write(path) as file:
        file.write(text.encode() + b"\n")


def read_stamped_json(file: Path) -> Mapping[str, Any]:
    """The content of an artefact in JSON, its stamp included.

    Raises:
        InputError: missing or damaged.
    """
    return mapping_entry(str(file), read_json(file, "what an earlier step writes"))


def read_stamped_npz(file: Path, keys: Sequence[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an artefact, or those of the given names only.

    Raises:
        InputError: missing or damaged.
    """
    return read_npz(file, "what an earlier step writes", keys)


def _add_path(found: Any, path: Path) -> None:
    if path.is_dir():
        for file in sorted(p for p in path.rglob("*") if p.is_file() and not p.name.startswith(".")):
            found.update(b"name" + os.fsencode(file.relative_to(path)) + b"\0")
            _add_path(found, file)
    elif path.is_file():
        with path.open("rb") as stream:
            found.update(b"file" + hashlib.file_digest(stream, "sha256").digest())
    else:
        found.update(b"absent\0")


def _plain(value: Any) -> Any:
    """Convert what JSON does not know."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)

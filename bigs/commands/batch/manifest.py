"""The manifest of a batch: which clips, each with options of its own. YAML, JSON, CSV or plain text."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from bigs.checks import InputError, check_choice, shown
from bigs.files import MAX_TEXT_BYTES, MAX_YAML_BYTES, parse_json, parse_yaml, read_text
from bigs.names import check_name, check_path

SUFFIXES = (".yaml", ".yml", ".json", ".csv", ".txt")
# Separates several values in a cell of a CSV file.
_SEPARATOR = ";"


@dataclass(frozen=True)
class Entry:
    """One clip of a batch; None and () stand for the batch's own options."""

    clip: Path
    name: str = ""  # name of the folder
    preset: str | None = None
    config: Path | None = None
    hand_model: Path | None = None
    gt: Path | None = None
    set: tuple[str, ...] = ()
    without: tuple[str, ...] = ()


_FIELDS = tuple(field.name for field in fields(Entry))
_PATHS = ("clip", "config", "hand_model", "gt")
_LISTS = ("set", "without")


def read_manifest(path: Path) -> list[Entry]:
    """The clips of a manifest, each with a name of its own.

    A text file has one clip per line. A CSV file has a heading with `clip` and any of the other fields;
    several values of a cell are separated by semicolons. YAML and JSON have a list of paths or of mappings,
    or a mapping with `clips` (such a list) and `defaults` (fields for all). Paths are relative to the
    manifest.

    Raises:
        InputError: no such file, another suffix, an unknown field, a value of another kind, no clip, or a
            name that comes twice.
    """
    check_choice(f"{path}: suffix", path.suffix.lower(), SUFFIXES)
    most = MAX_YAML_BYTES if path.suffix.lower() in (".yaml", ".yml") else MAX_TEXT_BYTES
    text = read_text(path, "a manifest", most)
    rows = [_entry(f"{path}: entry {i}", row, path.parent) for i, row in enumerate(_rows(path, text), 1)]
    if not rows:
        raise InputError(f"{path}: expected at least one clip, found none")
    return _named(path, rows)


def _rows(path: Path, text: str) -> Sequence[Any]:
    kind = path.suffix.lower()
    if kind == ".txt":
        lines = (line.split("#", 1)[0].strip() for line in text.splitlines())
        return [line for line in lines if line]
    if kind == ".csv":
        table = list(csv.DictReader(text.splitlines(), skipinitialspace=True))
        # csv puts surplus cells under None.
        return [{key or "more cells": cell for key, cell in row.items() if cell} for row in table]
    document = parse_json(str(path), text) if kind == ".json" else parse_yaml(str(path), text)
    defaults: Mapping[str, Any] = {}
    if isinstance(document, dict):
        other = set(document) - {"clips", "defaults"}
        if other:
            raise InputError(f"{path}: expected clips and defaults, found {shown(next(iter(other)))}")
        defaults = document.get("defaults") or {}
        document = document.get("clips")
        if not isinstance(defaults, dict):
            raise InputError(f"{path}: defaults: expected fields and values, found {shown(defaults)}")
    if not isinstance(document, list):
        raise InputError(f"{path}: expected a list of clips, found {type(document).__name__}")
    return [_with_defaults(defaults, row if isinstance(row, dict) else {"clip": row}) for row in document]


def _with_defaults(defaults: Mapping[str, Any], row: Mapping[str, Any]) -> dict[str, Any]:
    """A row's own values count; lists of settings add up, the row's last. A plan is a preset or a config."""
    plans = {"preset", "config"}
    inherited = {key: value for key, value in defaults.items() if key not in plans or not plans & row.keys()}
    both = {**inherited, **row}
    for key in _LISTS:
        parts = [values[key] for values in (defaults, row) if key in values]
        parts = [part.split(_SEPARATOR) if isinstance(part, str) else part for part in parts]
        if len(parts) == 2 and all(isinstance(part, list) for part in parts):
            both[key] = [*parts[0], *parts[1]]
    return both


def _entry(where: str, row: Any, folder: Path) -> Entry:
    values: dict[str, Any] = {"clip": row} if isinstance(row, str) else dict(row)
    for key, value in values.items():
        check_choice(f"{where}: field", key, _FIELDS)
        if key in _LISTS:
            parts = value.split(_SEPARATOR) if isinstance(value, str) else value
            if not isinstance(parts, list) or not all(isinstance(part, str) for part in parts):
                raise InputError(f"{where}: {key}: expected a list of texts, found {shown(value)}")
            values[key] = tuple(part.strip() for part in parts if part.strip())
        elif not isinstance(value, str) or not value:
            raise InputError(f"{where}: {key}: expected text, found {shown(value)}")
        elif key in _PATHS:
            values[key] = folder / check_path(f"{where}: {key}", value)
    if "clip" not in values:
        raise InputError(f"{where}: expected a field clip, found {', '.join(values) or 'nothing'}")
    name = values.get("name", "")
    if name and (not re.fullmatch(r"[\w.+-]+", name) or name.startswith(".")):
        raise InputError(
            f"{where}: name: expected letters, digits, '.', '+', '-' and '_', found {shown(name)}"
        )
    if name:
        check_name(f"{where}: name", name)
    return Entry(**values)


def _named(path: Path, entries: Sequence[Entry]) -> list[Entry]:
    """Name entries without a name after their clip's folder, with a number if it repeats."""
    given = [entry.name for entry in entries if entry.name]
    for name in given:
        if given.count(name) > 1:
            raise InputError(f"{path}: expected each name once, found {name!r} again")
    taken, named = set(given), []
    for entry in entries:
        name = entry.name
        if not name:
            place = entry.clip.resolve()
            folder = place.parent.name if place.name == "build" else place.name
            base = re.sub(r"[^\w.+-]", "_", folder).lstrip(".") or "clip"
            name, number = base, 1
            while name in taken:
                number += 1
                name = f"{base}_{number}"
            taken.add(check_name(f"{path}: {entry.clip}: name", name))
        named.append(replace(entry, name=name))
    return named

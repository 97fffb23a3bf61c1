"""Configurations as plain data: written beside a run, read back strictly, and changed by path."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from bigs.atomic import atomic_write
from bigs.checks import InputError, check_choice, meant, nearest, shown
from bigs.files import parse_yaml, read_yaml
from bigs.train.plan.config import RunConfig
from bigs.train.plan.ranges import check_ranges
from bigs.train.plan.renamed import check_renamed

# Messages show this much of a change.
_SHOWN = 80


def to_plain(config: Any) -> Any:
    """A dataclass as dicts, lists and scalars; a plan's stages become a dict by name."""
    if dataclasses.is_dataclass(config):
        return {f.name: to_plain(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, tuple) and config and all(dataclasses.is_dataclass(item) for item in config):
        return {item.name: {k: v for k, v in to_plain(item).items() if k != "name"} for item in config}
    if isinstance(config, tuple):
        return [to_plain(item) for item in config]
    # A copy, so that changing the plain form changes no preset.
    return dict(config) if isinstance(config, dict) else config


def from_plain(plain: Any, where: str = "config") -> RunConfig:
    """Build a `RunConfig` from plain data.

    Raises:
        InputError: an unknown key, a value of the wrong type or a number out of range, named by its path.
    """
    config: RunConfig = _build(RunConfig, plain, where)
    check_ranges(where, config)
    return config


def with_changes(config: RunConfig, changes: Iterable[str]) -> RunConfig:
    """A configuration with `path=value` changes, such as `raster.eps2d=0.2` or `stages.contact.steps=10`.

    A loss weight or learning rate may be added this way; every other key must exist.

    Raises:
        InputError: no such path, or a value of the wrong type.
    """
    plain = to_plain(config)
    for change in changes:
        path, separator, text = change.partition("=")
        keys = path.split(".")
        for open_ended in ("lrs", "weights"):
            # Groups are named subject.part, so what follows is one key.
            if open_ended in keys:
                place = keys.index(open_ended) + 1
                keys[place:] = [".".join(keys[place:])]
        node = plain
        for depth, key in enumerate(keys):
            is_last = depth == len(keys) - 1
            may_be_new = bool(key) and is_last and depth > 0 and keys[depth - 1] in ("lrs", "weights")
            if not separator or not isinstance(node, dict) or not (key in node or may_be_new):
                if not separator or not isinstance(node, dict):
                    raise InputError(f"--set {change}: expected path=value, found no setting {key!r}")
                check_renamed(f"--set {change}", key)
                check_choice(f"--set {change}", key, node, "settings")
            if not is_last:
                node = node[key]
        node[keys[-1]] = _scalar(change, text)
    try:
        return from_plain(plain, "--set")
    except InputError as error:
        raise InputError(str(error).replace("--set.", "--set ", 1)) from None


def _scalar(change: str, text: str) -> Any:
    """A value as YAML reads it, except that 1e-3 is a number, too."""
    value = parse_yaml(f"--set {change[:_SHOWN]}", text)
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            pass
    return value


def save_config(path: Path, config: RunConfig, extra: dict[str, Any]) -> None:
    """Write the resolved configuration and, above it, what else identifies the run."""
    text = yaml.safe_dump({**extra, "config": to_plain(config)}, sort_keys=False)
    with atomic_write(path) as file:
        file.write(text.encode())


def load_config(path: Path) -> RunConfig:
    """Read a configuration that `save_config` wrote.

    Raises:
        InputError: missing, not YAML, or not a configuration.
    """
    data = read_yaml(path, "a configuration file")
    if not isinstance(data, dict) or "config" not in data:
        raise InputError(f"{path}: expected a key 'config', found {type(data).__name__} without it")
    return from_plain(data["config"], str(path))


def _build(kind: Any, plain: Any, where: str) -> Any:
    """Check `plain` against the annotation `kind` and build the value."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _build_dataclass(kind, plain, where)
    if origin is types.UnionType:  # a setting that may be absent
        return None if plain is None else _build(arguments[0], plain, where)
    if origin is typing.Literal:
        check_choice(where, plain, arguments)
        return plain
    if origin is tuple:
        return _build_tuple(arguments, plain, where)
    if origin is dict:
        if not isinstance(plain, dict):
            raise InputError(f"{where}: expected a mapping, found {shown(plain)}")
        for key in plain:
            if not isinstance(key, str):
                raise InputError(f"{where}: expected names as keys, found {shown(key)}")
            check_renamed(where, key)
        return {key: _build(arguments[1], value, f"{where}.{key}") for key, value in plain.items()}
    if kind is float and isinstance(plain, int) and not isinstance(plain, bool):
        try:
            return float(plain)
        except OverflowError:
            raise InputError(f"{where}: expected a number, found {shown(plain)}") from None
    if not isinstance(plain, kind) or (kind in (int, float) and isinstance(plain, bool)):
        raise InputError(f"{where}: expected {kind.__name__}, found {shown(plain)}")
    return plain


def _build_tuple(arguments: tuple[Any, ...], plain: Any, where: str) -> tuple[Any, ...]:
    item = arguments[0]
    if isinstance(item, types.UnionType):  # the stages of a plan
        if not isinstance(plain, dict):
            raise InputError(f"{where}: expected stages by name, found {shown(plain)}")
        return tuple(_build_stage(item, name, stage, f"{where}.{name}") for name, stage in plain.items())
    if not isinstance(plain, list | tuple) or (arguments[-1] is not ... and len(plain) != len(arguments)):
        wanted = "a list" if arguments[-1] is ... else f"{len(arguments)} values"
        raise InputError(f"{where}: expected {wanted}, found {shown(plain)}")
    return tuple(_build(item, value, f"{where}[{i}]") for i, value in enumerate(plain))


def _build_stage(kinds: types.UnionType, name: str, plain: Any, where: str) -> Any:
    if not isinstance(plain, dict):
        raise InputError(f"{where}: expected a stage, found {shown(plain)}")
    first, *others = typing.get_args(kinds)
    common = {f.name for f in dataclasses.fields(first)}
    # The kind that most of the keys are peculiar to.
    own = {kind: {f.name for f in dataclasses.fields(kind)} - common for kind in others}
    kind = max(others, key=lambda kind: len(own[kind] & set(plain)))
    return _build_dataclass(kind if own[kind] & set(plain) else first, {"name": name, **plain}, where)


def _build_dataclass(kind: Any, plain: Any, where: str) -> Any:
    if not isinstance(plain, dict):
        raise InputError(f"{where}: expected a mapping, found {shown(plain)}")
    hints = typing.get_type_hints(kind)
    for key in plain:
        check_renamed(where, key)
        check_choice(where, key, hints, "keys")
    required = [
        f.name
        for f in dataclasses.fields(kind)
        if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
    ]
    for key in required:
        if key not in plain:
            raise InputError(f"{where}: expected a key {shown(key)}, found {', '.join(plain) or 'nothing'}")
    return kind(**{key: _build_field(hints, key, value, where) for key, value in plain.items()})


def _build_field(hints: dict[str, Any], key: str, value: Any, where: str) -> Any:
    """The value of a field; where it would suit another of nearly that name, the refusal says so."""
    try:
        return _build(hints[key], value, f"{where}.{key}")
    except InputError as error:
        other = nearest(key, (name for name in hints if name != key))
        if other is None or dataclasses.is_dataclass(hints[other]):
            raise
        try:
            _build(hints[other], value, where)
        except InputError:
            raise error from None
        raise InputError(f"{error}{meant(other)}") from None

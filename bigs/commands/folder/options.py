"""The options of an interrupted run against those it is resumed with."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from bigs.checks import InputError, shown
from bigs.commands.folder.clip import origin_of
from bigs.commands.folder.contents import CONFIG
from bigs.train.plan.config import RunConfig
from bigs.train.plan.config_file import load_config, to_plain
from bigs.train.plan.presets import PRESETS
from bigs.train.resolve import resolve

# Files may move between two parts of a run; what is in them is looked at when its checkpoint is read.
_PLACES = ("perceptual_weights", "prior.weights", "prior.controlnet", "prior.token", "prior.edge_weights")
_ABSENT = "none"


def check_same_options(run: Path, config: RunConfig, origin: Mapping[str, str | None]) -> None:
    """Refuse to resume a run with other options than its own.

    Args:
        run: the run folder, which has a config.yaml.
        config: what it is to be continued with, resolved.
        origin: `run_origin` of the clip and the hand model that it is to be continued with.

    Raises:
        InputError: names the first option that differs, what the run has and what was given.
    """
    again = f"give the run's own again (--config {run / CONFIG}) or another --out"
    stored = load_config(run / CONFIG)
    differing = [
        (path, old, new)
        for path, old, new in _differences(to_plain(stored), to_plain(config))
        if path not in _PLACES
    ]
    presets = {name: resolve(preset).config for name, preset in PRESETS.items()}
    names = [next((name for name, preset in presets.items() if preset == c), None) for c in (stored, config)]
    if differing and None not in names:
        raise InputError(f"--preset: expected {names[0]}, as the run has it, found {names[1]}; {again}")
    if differing:
        path, old, new = differing[0]
        more = f" (and {len(differing) - 1} more settings that differ)" if len(differing) > 1 else ""
        raise InputError(f"--set {path}: expected {old}, as the run has it, found {new}{more}; {again}")
    before = origin_of(run)
    if before.version not in (None, origin["bigs"]):
        raise InputError(
            f"{run}: expected a run of bigs {origin['bigs']}, found one of {before.version}; "
            "choose another --out"
        )
    own = None if before.hand_model is None else str(before.hand_model)
    models = own, origin["hand_model"]
    if (models[0] is None) != (models[1] is None):
        old, new = ("the built-in hand" if model is None else model for model in models)
        raise InputError(f"--hand-model: expected {old}, as the run has it, found {new}")


def _differences(old: Any, new: Any, where: str = "") -> Iterator[tuple[str, str, str]]:
    """Paths of settings that differ, as --set names them, with both values."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        if old != new:
            yield where, _text(old), _text(new)
        return
    for key in dict.fromkeys((*old, *new)):
        path = f"{where}.{key}" if where else key
        if key not in old or key not in new:
            yield path, _text(old.get(key)), _text(new.get(key))
        else:
            yield from _differences(old[key], new[key], path)


def _text(value: Any) -> str:
    return _ABSENT if value is None else shown(value)

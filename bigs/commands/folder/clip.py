"""The clip and the hand models that a run was made from, for what shows images or truth beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from bigs.checks import InputError, shown
from bigs.commands.clips.open import open_clip
from bigs.commands.folder.contents import CONFIG
from bigs.data.base import Clip
from bigs.files import read_yaml
from bigs.hand import HandModel, load_hand_models
from bigs.names import check_path
from bigs.types import Side


def clip_of_run(run: Path, frames: int, given: Path | None = None) -> Clip | None:
    """The clip of a run, with as many frames: the given one, or the one that the run names.

    Returns:
        None when the run's own clip has moved or changed since: that is not worth a refusal.

    Raises:
        InputError: the given clip is invalid, or not the run's.
    """
    if given is not None:
        clip = open_clip(given, load_hand_models(None))
        if len(clip) != frames:
            raise InputError(f"{given}: expected the {frames} frames of {run}, found {len(clip)}")
        return clip
    stored = origin_of(run).clip
    if stored is None:
        return None
    try:
        clip = open_clip(stored, load_hand_models(None))
    except InputError:
        return None
    return clip if len(clip) == frames else None


def hand_models_of_run(run: Path) -> Mapping[Side, HandModel]:
    """The models that a run was made with; the built-in ones if theirs are gone.

    Raises:
        InputError: the models' files are there and not as they should be.
    """
    stored = origin_of(run).hand_model
    return load_hand_models(stored if stored is not None and stored.exists() else None)


class Origin(NamedTuple):
    """What a run was made from; None where its config.yaml does not tell."""

    clip: Path | None
    hand_model: Path | None
    version: str | None  # of bigs


def origin_of(run: Path) -> Origin:
    """What the run's config.yaml says; nothing when it cannot be read."""
    try:
        found = read_yaml(run / CONFIG)
    except InputError:
        found = {}
    stored = found if isinstance(found, dict) else {}
    version = stored.get("bigs")
    return Origin(
        _path(stored.get("clip")),
        _path(stored.get("hand_model")),
        version if version is None or isinstance(version, str) else shown(version),
    )


def _path(value: Any) -> Path | None:
    try:
        return Path(check_path(CONFIG, value))
    except InputError:
        return None

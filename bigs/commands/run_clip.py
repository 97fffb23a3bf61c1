"""The clip that a run was made from, for what shows its images."""

from __future__ import annotations

from pathlib import Path

import yaml

from bigs.checks import InputError
from bigs.commands.run_folder import CONFIG
from bigs.data.base import Clip
from bigs.data.hold import load_hold


def clip_of_run(run: Path, frames: int, given: Path | None = None) -> Clip | None:
    """The clip of a run of so many frames: the one that is given, or the one that the run names.

    Returns:
        None when the run's own clip has moved or changed since: that is not worth a refusal.

    Raises:
        InputError: the given clip is not as it should be, or not the run's.
    """
    if given is not None:
        clip = load_hold(given)
        if len(clip) != frames:
            raise InputError(f"{given}: expected the {frames} frames of {run}, found {len(clip)}")
        return clip
    try:
        clip = load_hold(Path(yaml.safe_load((run / CONFIG).read_text())["clip"]))
    except (OSError, yaml.YAMLError, InputError, KeyError, TypeError):
        return None
    return clip if len(clip) == frames else None

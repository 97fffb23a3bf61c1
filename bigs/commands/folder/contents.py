"""The files of a run folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bigs.atomic import atomic_write
from bigs.checks import InputError, found_at, meant
from bigs.data.entries import array_entry, mapping_entry
from bigs.files import read_json
from bigs.models.playback import Playback
from bigs.models.playback_file import load_playback

CHECKPOINTS = "checkpoints"
CONFIG = "config.yaml"
LOG = "log.jsonl"
METRICS = "metrics.json"
PREVIEW_PICTURE = "preview.png"
PREVIEW_VIDEO = "preview.mp4"
REPORT = "report.html"
SCENE = "scene.safetensors"


def load_run(run: Path) -> Playback:
    """The finished reconstruction in a run folder.

    Raises:
        InputError: no such folder, or the run has not finished.
    """
    if not run.is_dir():
        raise InputError(f"{run}: expected a run folder, found {found_at(run)}")
    if not (run / SCENE).exists() and not (run / CONFIG).exists():
        inside = sorted(scene.parent for scene in run.glob(f"*/{SCENE}"))
        if inside:
            raise InputError(f"{run}: expected a run folder, found a folder of runs{meant(str(inside[0]))}")
    return load_playback(run / SCENE)


def read_scores(run: Path) -> dict[str, dict[str, float]]:
    """The content of a run's `metrics.json`: scores by key, of the result and of the start.

    Returns:
        Nothing where there is no such file.

    Raises:
        InputError: it is damaged.
    """
    path = run / METRICS
    if not path.exists():
        return {}
    stored = mapping_entry(str(path), read_json(path, "a run's scores"))
    return {
        column: {
            key: float(array_entry(f"{path}: {column}.{key}", value, (), finite=False))
            for key, value in mapping_entry(f"{path}: {column}", scores).items()
        }
        for column, scores in stored.items()
    }


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write a JSON file, whole or not at all."""
    with atomic_write(path) as file:
        file.write(json.dumps(values, indent=2).encode())

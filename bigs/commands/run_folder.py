"""The folder of a run: what lies where, and how a finished scene is written into it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from bigs.atomic import atomic_write
from bigs.checks import InputError
from bigs.export.challenge import write_challenge
from bigs.export.mesh import save_mesh
from bigs.export.ply import save_splats
from bigs.export.poses import ClipPoses, HandPoses, ObjectPoses, save_poses
from bigs.models.playback import Playback, load_playback, save_playback
from bigs.types import Entity, Gaussians

CHECKPOINTS = "checkpoints"
CONFIG = "config.yaml"
LOG = "log.jsonl"
METRICS = "metrics.json"
PREVIEW_PICTURE = "preview.png"
PREVIEW_VIDEO = "preview.mp4"
REPORT = "report.html"
SCENE = "scene.safetensors"

FORMATS = ("ply", "poses", "challenge", "mesh", "hand-meshes")


def load_run(run: Path) -> Playback:
    """The finished reconstruction in a run folder.

    Raises:
        InputError: no such folder, or the run has not finished.
    """
    if not run.is_dir():
        raise InputError(f"{run}: expected a run folder, found {'a file' if run.exists() else 'nothing'}")
    return load_playback(run / SCENE)


def write_outputs(run: Path, playback: Playback) -> None:
    """Write the scene and every format that a run has by default."""
    save_playback(run / SCENE, playback)
    for name in ("ply", "poses", "challenge", "mesh"):
        write_format(run, playback, name)


def write_format(folder: Path, playback: Playback, name: str) -> list[Path]:
    """Write one of `FORMATS` below `folder`; returns the files: none for an absent entity."""
    writers = {
        "ply": _write_splats,
        "poses": _write_poses,
        "challenge": _write_challenge,
        "mesh": _write_object_mesh,
        "hand-meshes": _write_hand_meshes,
    }
    files = writers[name](folder, playback)
    return list(files)


def _ready(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _write_splats(folder: Path, playback: Playback) -> Iterable[Path]:
    names: dict[Entity, str] = {"right": "hand", "left": "hand", "object": "object"}
    if not playback.shares_hand:
        names["left"] = "hand_left"
    for entity, name in names.items():
        # One canonical hand that serves both sides is written once.
        if entity in playback.entities and not (
            entity == "left" and "right" in playback.hands and playback.shares_hand
        ):
            yield _save(folder, name, playback.canonical(entity))


def _save(folder: Path, name: str, gaussians: Gaussians) -> Path:
    path = _ready(folder / "gaussians" / f"{name}.ply")
    save_splats(path, gaussians)
    return path


def _write_poses(folder: Path, playback: Playback) -> Iterable[Path]:
    hands = {
        side: HandPoses(
            hand.global_orient_aa.numpy(), hand.hand_pose_aa.numpy(), hand.transl.numpy(), hand.betas.numpy()
        )
        for side, hand in playback.hands.items()
    }
    obj = None
    if playback.object is not None:
        o = playback.object
        obj = ObjectPoses(o.rotations.numpy(), o.centers.numpy(), float(o.scale))
    path = _ready(folder / "poses.npz")
    save_poses(path, ClipPoses(playback.frame_names, playback.K.numpy(), hands, obj))
    yield path


def _write_challenge(folder: Path, playback: Playback) -> Iterable[Path]:
    if playback.object is None:
        return
    path = _ready(folder / "arctic_preds" / f"{playback.name}.pt")
    left = playback.hands.get("left")
    write_challenge(
        path,
        playback.trajectory(),
        playback.normalize_shift,
        v_posed_left=None if left is None else left.v_posed.numpy(),
    )
    yield path


def _write_object_mesh(folder: Path, playback: Playback) -> Iterable[Path]:
    if playback.object is not None:
        path = _ready(folder / "meshes" / "object.ply")
        obj = playback.object
        save_mesh(path, (obj.scale * obj.verts).numpy(), obj.faces.numpy())
        yield path


def _write_hand_meshes(folder: Path, playback: Playback) -> Iterable[Path]:
    for side, hand in playback.hands.items():
        for t, verts in enumerate(hand.verts.numpy()):
            path = _ready(folder / "meshes" / f"{side}_{t:04d}.ply")
            save_mesh(path, verts, hand.faces.numpy())
            yield path


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write a JSON file, whole or not at all."""
    with atomic_write(path) as file:
        file.write(json.dumps(values, indent=2).encode())

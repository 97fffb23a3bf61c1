"""Checkpoints: scene, optimiser and position in the plan in one safetensors file, replaced atomically."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from bigs.atomic import atomic_write
from bigs.checks import InputError
from bigs.checksum import checksum
from bigs.files import check_regular
from bigs.models.hand_detail import free_hand
from bigs.models.object_detail import ObjectDetail
from bigs.models.object_splats import Anchors, ObjectSplats
from bigs.models.scene import ObjectSurface, Scene
from bigs.train.loop.density import Pull
from bigs.train.loop.run_stage import NUMBERS, StageState

FORMAT = "bigs-checkpoint-5"
FILE_NAME = "latest.safetensors"


class Position(NamedTuple):
    """Where to continue."""

    stage: int  # index of the stage to run next, or to continue
    resume: dict[str, Any] | None  # what `StageState` holds; None at a stage's start
    report: dict[str, Any]  # as it was saved


def save_checkpoint(
    folder: Path, scene: Scene, digest: str, stage: int, state: StageState | None, report: dict[str, Any]
) -> None:
    """Write the state after `state.step` steps of `stage`, or before its first when `state` is None.

    Args:
        folder: made if missing.
        scene: the scene.
        digest: identifies clip, configuration and version; a checkpoint of another run is refused.
        stage: index in the plan.
        state: what `run_stage` passes to its hook.
        report: plain data on what happened so far, kept for the report of the whole run.
    """
    tensors = {f"scene.{name}": value for name, value in scene.state_dict().items()}
    position: dict[str, Any] = {"stage": stage, "step": None}
    if state is not None:
        position |= {key: getattr(state, key) for key in NUMBERS}
        for index, moments in state.optimizer.moments().items():
            tensors |= {f"optimizer.{index}.{key}": value for key, value in moments.items()}
        tensors |= {f"found.{name}": value for name, value in state.found.items()}
        if state.pull is not None:
            tensors |= {f"pull.{name}": value for name, value in state.pull._asdict().items()}
    tensors = {name: value.contiguous() for name, value in tensors.items()}
    metadata = {
        "format": FORMAT,
        "digest": digest,
        "position": json.dumps(position),
        "report": json.dumps(report),
    }
    metadata["checksum"] = _checksum(metadata, tensors)
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / FILE_NAME) as file:
        file.write(save(tensors, metadata))


def _checksum(metadata: dict[str, str], tensors: dict[str, Tensor]) -> str:
    """A checksum that reveals changed bits."""
    return checksum(json.dumps(sorted(item for item in metadata.items() if item[0] != "checksum")), tensors)


def load_checkpoint(folder: Path, scene: Scene, digest: str) -> Position | None:
    """Restore `scene` and say where to continue; None when there is no checkpoint.

    Raises:
        InputError: the file is damaged, or belongs to another clip, configuration or version.
    """
    path = folder / FILE_NAME
    if not path.exists():
        return None
    check_regular(path, "a checkpoint")
    damaged = f"{path}: expected a checkpoint, found a damaged file (remove it to start again)"
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(f"{damaged}: {error}") from error
    if metadata.get("format") != FORMAT:
        raise InputError(f"{path}: expected format {FORMAT}, found {metadata.get('format')}")
    if metadata.get("checksum") != _checksum(metadata, tensors):
        raise InputError(f"{damaged}: its checksum is not that of its content")
    if metadata.get("digest") != digest:
        raise InputError(
            f"{path}: expected a checkpoint of this clip, hand model, configuration and version, "
            "found one of another run (name another --out, or remove the folder)"
        )
    for side, hand in scene.hand_splats.items():
        if f"scene.hand_splats.{side}.shift" in tensors:
            scene.hand_splats[side] = free_hand(hand)
    count = len(tensors.get("scene.object_splats.shift", ()))
    if count and not (
        isinstance(scene.object_splats, ObjectDetail) and len(scene.object_splats.shift) == count
    ):
        scene.object_splats = ObjectDetail(count)
    if isinstance(scene.object_splats, ObjectSplats):
        # Their number may differ, since they may have been cloned, split and pruned.
        scene.object_splats.place(Anchors(*(tensors[f"scene.object_splats.{n}"] for n in Anchors._fields)))
    if "scene.surface_verts" in tensors:
        scene.replace_surface(ObjectSurface(tensors["scene.surface_verts"], tensors["scene.surface_faces"]))
    if scene.lighting is not None:
        for entity, occlusion in scene.lighting.occlusion.items():
            known = f"scene.lighting.occlusion.{entity}"
            occlusion.place(tensors[f"{known}.places"], tensors[f"{known}.shares"])
    scene.load_state_dict(
        {name.removeprefix("scene."): value for name, value in tensors.items() if name.startswith("scene.")}
    )
    position, report = json.loads(metadata["position"]), json.loads(metadata["report"])
    if position["step"] is None:
        return Position(position["stage"], None, report)
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".")
            moments.setdefault(int(index), {})[key] = value
    resume = {key: position[key] for key in NUMBERS}
    found = {
        name.removeprefix("found."): value for name, value in tensors.items() if name.startswith("found.")
    }
    pull = Pull(*(tensors[f"pull.{n}"] for n in Pull._fields)) if "pull.total" in tensors else None
    return Position(position["stage"], resume | {"moments": moments, "found": found, "pull": pull}, report)

"""`scene.safetensors`, a playback as a file: written with a checksum, and checked whole when it is read."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from bigs.atomic import atomic_write
from bigs.checks import (
    InputError,
    check_faces,
    check_finite,
    check_pixels,
    check_positive,
    check_product,
    check_rotations,
    check_shape,
    shown,
)
from bigs.checksum import checksum
from bigs.files import check_regular, parse_json
from bigs.models.canonical import CanonicalHand, CanonicalObject
from bigs.models.playback import HandPlayback, ObjectPlayback, Playback
from bigs.names import check_name
from bigs.types import SIDES, USUAL_FPS, Side

FORMAT = "bigs-scene-5"
# The format before, without occlusion, and the one before that, without a checksum and grasps as well.
_UNCOVERED, _UNSUMMED = "bigs-scene-4", "bigs-scene-3"
# No camera has more pixels on a side.
_MOST_PIXELS = 1 << 16

Shape = tuple[int | str, ...]


def save_playback(path: Path, playback: Playback) -> None:
    """Write a playback as one safetensors file with a checksum of all that it holds."""
    tensors: dict[str, Tensor] = {"K": playback.K}
    if playback.light is not None:
        tensors["light"] = playback.light
    for side, hand in playback.hands.items():
        named = {f.name: getattr(hand, f.name) for f in fields(hand) if f.name != "splats"}
        named |= {f"splats.{key}": value for key, value in hand.splats._asdict().items() if value is not None}
        tensors |= {f"{side}.{key}": value for key, value in named.items()}
    if playback.object is not None:
        obj = playback.object
        named = {f.name: getattr(obj, f.name) for f in fields(obj) if f.name != "splats"}
        named |= {f"splats.{key}": value for key, value in obj.splats._asdict().items()}
        tensors |= {f"object.{key}": value for key, value in named.items()}
    facts: dict[str, Any] = {
        "name": playback.name,
        "frame_names": playback.frame_names,
        "size": [playback.width, playback.height],
        "normalize_shift": playback.normalize_shift,
        "fps": playback.fps,
        "black": playback.black,
    }
    facts = {"format": FORMAT, **facts}
    # A single key, since the writer's order of keys differs from run to run.
    metadata = {"bigs": json.dumps({**facts, "checksum": checksum(json.dumps(facts), tensors)})}
    # Shared storage (one canonical hand for two sides) is written twice, so that readers need no special
    # case.
    with atomic_write(path) as file:
        file.write(save({key: value.contiguous().clone() for key, value in tensors.items()}, metadata))


def load_playback(path: Path) -> Playback:
    """Read what `save_playback` wrote, or two earlier versions did.

    Raises:
        InputError: missing, damaged, of another format, or with a part that does not fit.
    """
    check_regular(path, "a finished run's scene")
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get("bigs", "{}")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except Exception as error:  # safetensors raises its own errors, and torch's for unknown types
        raise InputError(f"{path}: expected a scene file, found a damaged one ({error})") from error
    facts = parse_json(f"{path}: metadata", text)
    if not isinstance(facts, dict):
        raise InputError(f"{path}: metadata: expected a dictionary, found {shown(facts)}")
    if facts.get("format") not in (FORMAT, _UNCOVERED, _UNSUMMED):
        raise InputError(f"{path}: expected format {FORMAT}, found {shown(facts.get('format'))}")
    stored = facts.pop("checksum", None)
    expected = None if facts["format"] == _UNSUMMED else checksum(json.dumps(facts), tensors)
    if stored != expected:
        raise InputError(
            f"{path}: expected the checksum {expected} of its content, found {shown(stored)}: the file was "
            "damaged (bigs reconstruct --resume into the same folder writes it again)"
        )
    # What earlier versions did not store.
    facts.setdefault("fps", USUAL_FPS)
    facts.setdefault("black", 0.0)
    if facts["format"] == _UNSUMMED:
        tensors |= _without_grasps(tensors)
    if facts["format"] != FORMAT:
        tensors |= _without_occlusion(str(path), tensors)
    _check(str(path), facts, tensors)
    return _assemble(facts, tensors)


def _without_grasps(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Placeholders for the grasps that a file of an earlier version lacks."""
    found: dict[str, Tensor] = {}
    for side in SIDES:
        joints = tensors.get(f"{side}.joints")
        if joints is not None and joints.ndim:
            found[f"{side}.grasp"] = torch.full((len(joints),), -1)
            found[f"{side}.grasp_certainty"] = torch.zeros(len(joints))
    return found


def _without_occlusion(where: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What stands for the occlusion that a file of an earlier version lacks: nothing covers anything."""
    found: dict[str, Tensor] = {}
    for entity, splats in (("right", "points"), ("left", "points"), ("object", "means")):
        shade, points = (tensors.get(f"{entity}.{name}") for name in ("shade", f"splats.{splats}"))
        if shade is not None and points is not None and shade.ndim and points.ndim:
            check_product(f"{where}: {entity}", len(shade), len(points))
            found[f"{entity}.occlusion"] = torch.zeros(len(shade), len(points), dtype=torch.uint8)
            found[f"{entity}.ambient"] = torch.zeros(3)
    return found


def _check(where: str, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Check that everything exists, fits together and is finite, and that there is nothing else."""
    _check_facts(where, facts)
    frames = len(facts["frame_names"])
    shapes: dict[str, Shape] = {"K": (3, 3)}
    if "light" in tensors:
        shapes["light"] = (8, 3)
    for side in SIDES:
        if any(name.startswith(f"{side}.") for name in tensors):
            shapes |= _hand_shapes(side, frames, tensors)
    if any(name.startswith("object.") for name in tensors):
        shapes |= _object_shapes(frames, tensors)
    for name in tensors.keys() - shapes.keys():
        raise InputError(f"{where}: expected no tensor {name}, found it")
    for name, shape in shapes.items():
        if name not in tensors:
            raise InputError(f"{where}: expected a tensor {name}, found none")
        check_shape(f"{where}: {name}", tensors[name], shape)
        dtype = torch.float32
        if name.endswith(("faces", "tip_vertex_ids", ".grasp")):
            dtype = torch.int64
        elif name.endswith(".occlusion"):
            dtype = torch.uint8
        if tensors[name].dtype != dtype:
            expected, found = (str(kind).removeprefix("torch.") for kind in (dtype, tensors[name].dtype))
            raise InputError(f"{where}: {name}: expected {expected}, found {found}")
        if dtype == torch.float32:
            check_finite(f"{where}: {name}", tensors[name])
    for name in [name for name in shapes if name.endswith(".faces")]:
        check_faces(f"{where}: {name}", tensors[name], tensors[name.replace("faces", "verts")].shape[-2])
    for name in [name for name in shapes if name.endswith(".tip_vertex_ids")]:
        tips = tensors[name]
        count = tensors[name.replace("tip_vertex_ids", "verts")].shape[1]
        if tips.min() < 0 or tips.max() >= count:
            raise InputError(f"{where}: {name}: expected indices below {count}, found {tips.tolist()}")
    for name in [name for name in shapes if name.endswith((".rotations", ".hand_pose"))]:
        check_rotations(f"{where}: {name}", tensors[name])
    if "object.scale" in shapes:
        check_positive(f"{where}: object.scale", float(tensors["object.scale"]))


def _check_facts(where: str, facts: Mapping[str, Any]) -> None:
    name, names = facts.get("name"), facts.get("frame_names")
    size, shift = facts.get("size"), facts.get("normalize_shift")
    check_name(f"{where}: name", name)
    if not isinstance(names, list) or not names or not all(isinstance(frame, str) for frame in names):
        raise InputError(f"{where}: frame_names: expected a list of texts, found {shown(names)}")
    if not isinstance(size, list) or len(size) != 2 or not all(_is_pixels(side) for side in size):
        raise InputError(f"{where}: size: expected a width and a height in pixels, found {shown(size)}")
    check_pixels(f"{where}: size", *size)
    if not isinstance(shift, list) or len(shift) != 3 or not all(_is_finite(part) for part in shift):
        raise InputError(f"{where}: normalize_shift: expected three numbers, found {shown(shift)}")
    if not _is_finite(facts["fps"]) or facts["fps"] <= 0.0:
        raise InputError(f"{where}: fps: expected a positive number, found {shown(facts['fps'])}")
    if not _is_finite(facts["black"]) or not 0.0 <= facts["black"] < 1.0:
        raise InputError(f"{where}: black: expected a number from 0 to 1, found {shown(facts['black'])}")


def _is_pixels(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 < value <= _MOST_PIXELS


def _is_finite(value: Any) -> bool:
    return isinstance(value, float) and math.isfinite(value)


def _hand_shapes(side: Side, frames: int, tensors: Mapping[str, Tensor]) -> dict[str, Shape]:
    n_verts, count = (
        _length(tensors, f"{side}.verts", 1, "V"),
        _length(tensors, f"{side}.splats.points", 0, "N"),
    )
    v_posed = tensors.get(f"{side}.v_posed")
    shapes: dict[str, Shape] = {
        "joints": (frames, 21, 3),
        "verts": (frames, "V", 3),
        "faces": ("F", 3),
        "bones": (frames, 16, 4, 4),
        "hand_pose": (frames, 15, 3, 3),
        "shade": (frames, 20),
        "occlusion": (frames, count),
        "ambient": (3,),
        "global_orient_aa": (frames, 3),
        "hand_pose_aa": (frames, 15, 3),
        "transl": (frames, 3),
        "betas": (10,),
        "v_posed": (frames, n_verts, 3)[-v_posed.ndim :]
        if v_posed is not None and v_posed.ndim in (2, 3)
        else (n_verts, 3),
        "lbs_weights": (n_verts, 16),
        "rest_joints": (16, 3),
        "tip_vertex_ids": (5,),
        "grasp": (frames,),
        "grasp_certainty": (frames,),
        "splats.points": ("N", 3),
        "splats.shapedirs": (count, 3, "any"),
        "splats.weights": (count, 16),
        "splats.scales": (count, 3),
        "splats.opacities": (count,),
        "splats.colors": (count, "D"),
    }
    optional: dict[str, Shape] = {"splats.posedirs": (count, 3, 135), "splats.quats": (count, 4)}
    shapes |= {name: shape for name, shape in optional.items() if f"{side}.{name}" in tensors}
    return {f"{side}.{name}": shape for name, shape in shapes.items()}


def _object_shapes(frames: int, tensors: Mapping[str, Tensor]) -> dict[str, Shape]:
    count = _length(tensors, "object.splats.means", 0, "N")
    shapes: dict[str, Shape] = {
        "rotations": (frames, 3, 3),
        "centers": (frames, 3),
        "scale": (),
        "verts": ("V", 3),
        "faces": ("F", 3),
        "shade": (frames, 20),
        "occlusion": (frames, count),
        "ambient": (3,),
        "splats.means": ("N", 3),
        "splats.offsets": (count, 3),
        "splats.quats": (count, 4),
        "splats.scales": (count, 3),
        "splats.opacities": (count,),
        "splats.colors": (count, "D"),
        "splats.normals": (count, 3),
        "splats.weights": (count, 16),
    }
    return {f"object.{name}": shape for name, shape in shapes.items()}


def _length(tensors: Mapping[str, Tensor], name: str, axis: int, unknown: str) -> int | str:
    """The size of an axis, or any number if the tensor or the axis is missing."""
    stored = tensors.get(name)
    return unknown if stored is None or stored.ndim <= axis else stored.shape[axis]


def _assemble(metadata: dict[str, Any], tensors: dict[str, Tensor]) -> Playback:
    """A playback from the contents of its file, which have been checked."""

    def part(prefix: str) -> dict[str, Tensor]:
        return {key.removeprefix(prefix): v for key, v in tensors.items() if key.startswith(prefix)}

    hands: dict[Side, HandPlayback] = {}
    for side in SIDES:
        splats = part(f"{side}.splats.")
        if splats:
            # What a hand may lack is not in the file.
            whole: dict[str, Any] = {key: splats.get(key) for key in CanonicalHand._fields}
            rest = {k: v for k, v in part(f"{side}.").items() if not k.startswith("splats.")}
            hands[side] = HandPlayback(**rest, splats=CanonicalHand(**whole))
    obj = None
    if "object.verts" in tensors:
        rest = {k: v for k, v in part("object.").items() if not k.startswith("splats.")}
        obj = ObjectPlayback(**rest, splats=CanonicalObject(**part("object.splats.")))
    width, height = metadata["size"]
    return Playback(
        metadata["name"],
        tuple(metadata["frame_names"]),
        tensors["K"],
        width,
        height,
        tuple(metadata["normalize_shift"]),
        tensors.get("light"),
        hands,
        obj,
        metadata["fps"],
        metadata["black"],
    )

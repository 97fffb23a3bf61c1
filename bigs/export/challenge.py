"""The prediction file of the ARCTIC bimanual category-agnostic reconstruction challenge: `<sequence>.pt`.

One flat dictionary (`"j3d_ra.right"` is a key), all in metres and camera axes but for `verts.*`, which live
in the scaled space HOLD trains in. Numbers are float16 (0.5 mm steps at arm's length) and faces int16, as the
challenge has them; faces of a mesh with more than 32768 vertices do not fit and are int32. A hand that the
clip lacks has no keys.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, BinaryIO

import numpy as np
import torch

from bigs.atomic import atomic_write
from bigs.checks import InputError, check_finite, check_shape, shown
from bigs.files import open_regular
from bigs.names import check_name, check_path
from bigs.torch_files import load_torch
from bigs.types import ENTITIES, SIDES, HandObjectTrajectory, Side

# Keys have two parts.
_DEEPEST = 4
# HOLD's axes: x right, y up, z backward.
_GL_FROM_CV = np.array([1.0, -1.0, -1.0])
# HOLD's scale is scene_bounding_sphere / (max_radius_ratio |n|), and these two are 6 and 3 by default.
_SCENE_RADIUS = 2.0
# Best possible accuracy of the difference of two float16 numbers of about a metre.
_HALF_TOLERANCE = 2e-3


def write_challenge(
    path: str | Path,
    trajectory: HandObjectTrajectory,
    normalize_shift: Sequence[float],
    *,
    v_posed_left: np.ndarray | None = None,
    scene_scale: float | None = None,
) -> None:
    """Write the predictions of one clip; `path` is whole or absent.

    Args:
        path: `<sequence>.pt`.
        trajectory: meshes and joints, with faces for every mesh.
        normalize_shift: n of the clip's `data.npy`, [3] metres; places `verts.*` at s (F x_cam + n), where
            F = diag(1, -1, -1).
        v_posed_left: the left hand's vertices with shape and pose correctives but before skinning, [V, 3] or
            [T, V, 3] metres; needed when there is a left hand.
        scene_scale: s; 2 / |n| when not given, HOLD's default.

    Raises:
        InputError: something is missing, does not fit, or is not finite (also once in float16).
    """
    shift = np.asarray(normalize_shift, dtype=np.float64)
    check_shape(f"{path}: normalize_shift", shift, (3,))
    check_finite(f"{path}: normalize_shift", shift)
    if scene_scale is None:
        if not shift.any():
            raise InputError(f"{path}: normalize_shift: expected a shift other than zero, found zero")
        scene_scale = _SCENE_RADIUS / float(np.linalg.norm(shift))
    points = _camera_space(str(path), trajectory)
    for entity in ("right", "object"):
        if f"v3d_c.{entity}" in points:
            points[f"verts.{entity}"] = scene_scale * (points[f"v3d_c.{entity}"] * _GL_FROM_CV + shift)
    if "v3d_c.left" in points:
        if v_posed_left is None:
            raise InputError(
                f"{path}: v_posed_left: expected vertices for a clip with a left hand, found none"
            )
        frames, n_verts, _ = points["v3d_c.left"].shape
        check_shape(f"{path}: v_posed_left", v_posed_left, (frames, n_verts, 3)[-v_posed_left.ndim :])
        points["v_posed.left"] = np.broadcast_to(v_posed_left, (frames, n_verts, 3))
    content: dict[str, Any] = {
        "fnames": [
            f"./data/{trajectory.name}/build/image/{t:04d}.png" for t in range(len(trajectory.frame_names))
        ],
        "full_seq_name": trajectory.name,
        **{key: _half(f"{path}: {key}", values) for key, values in points.items()},
        "faces": _faces(str(path), trajectory, points),
    }
    _check(str(path), content)
    buffer = io.BytesIO()
    torch.save(content, buffer)
    with atomic_write(path) as file:
        file.write(buffer.getbuffer())


def load_challenge(path: str | Path, frame_names: Sequence[str] | None = None) -> HandObjectTrajectory:
    """Read predictions, ours or others', without running anything that the file may ask for.

    Args:
        path: `<sequence>.pt`.
        frame_names: the clip's own names of its frames (its `corres.txt`), in order; the file knows image
            names only, which are used when this is not given.

    Raises:
        InputError: the file is missing, damaged or holds other things than containers and tensors; a field
            does not fit, is not finite or contradicts another; or the number of names is not that of the
            frames.
    """
    content = _read(Path(path))
    _check(str(path), content)
    names = frame_names if frame_names is not None else [PurePath(name).name for name in content["fnames"]]
    if len(names) != len(content["fnames"]):
        raise InputError(f"{path}: expected {len(names)} frames, found {len(content['fnames'])}")

    def per_side(group: str) -> dict[Side, np.ndarray]:
        keys: dict[Side, str] = {side: f"{group}.{side}" for side in SIDES}
        return {side: content[key].double().numpy() for side, key in keys.items() if key in content}

    object_verts = content.get("v3d_c.object")
    faces = {node: stored.long().numpy() for node, stored in content["faces"].items()}
    return HandObjectTrajectory(
        name=content["full_seq_name"],
        frame_names=tuple(names),
        joints=per_side("j3d_c"),
        verts=per_side("v3d_c"),
        faces={side: faces[side] for side in SIDES if side in faces},
        object_verts=None if object_verts is None else object_verts.double().numpy(),
        object_faces=faces.get("object"),
    )


def validate_challenge(path: str | Path, stream: BinaryIO | None = None) -> dict[str, Any]:
    """Check that a prediction file has every key of the challenge in its type, and that they fit together.

    Args:
        path: `<sequence>.pt`, or what to call it in messages.
        stream: its bytes, where they lie elsewhere than in that file.

    Returns:
        What the file holds, faces apart as `faces`.

    Raises:
        InputError: the first thing that is wrong.
    """
    content = _read(Path(path)) if stream is None else _parse(str(path), stream)
    _check(str(path), content)
    present = _entities(content)
    wanted = [key for key in _shapes(present, 0, {}) if key not in content]
    wanted += [f"faces.{entity}" for entity in present if entity not in content["faces"]]
    if wanted:
        raise InputError(f"{path}: expected a field {wanted[0]}, found none")
    _check_types(str(path), content)
    return content


def _camera_space(where: str, trajectory: HandObjectTrajectory) -> dict[str, np.ndarray]:
    """Joints, vertices, roots, and each relative to its root, under the challenge's keys."""
    points: dict[str, np.ndarray] = {}
    frames = len(trajectory.frame_names)
    for side in SIDES:
        joints = trajectory.joints.get(side)
        if joints is not None:
            check_shape(f"{where}: j3d_c.{side}", joints, (frames, 21, 3))
            points[f"j3d_c.{side}"] = joints
            points[f"j3d_ra.{side}"] = joints - joints[:, :1]
            points[f"root.{side}"] = joints[:, 0]
            if trajectory.verts.get(side) is None:
                raise InputError(f"{where}: v3d_c.{side}: expected the vertices of the hand, found none")
            check_shape(f"{where}: v3d_c.{side}", trajectory.verts[side], (frames, "V", 3))
            points[f"v3d_c.{side}"] = trajectory.verts[side]
    verts = trajectory.object_verts
    if verts is not None:
        check_shape(f"{where}: v3d_c.object", verts, (frames, "V", 3))
        centre = 0.5 * (verts.min(axis=1) + verts.max(axis=1))
        points["root.object"] = centre
        points["v3d_c.object"] = verts
        points["v3d_ra.object"] = verts - centre[:, None]
        for side in SIDES:
            if f"root.{side}" in points:
                points[f"v3d_{side}.object"] = verts - points[f"root.{side}"][:, None]
    return points


def _half(name: str, values: np.ndarray) -> torch.Tensor:
    check_finite(name, values)
    with np.errstate(over="ignore"):  # an overflow is named by the check below
        half = np.asarray(values).astype(np.float16)
    check_finite(f"{name} as float16", half)
    return torch.from_numpy(half)


def _faces(
    where: str, trajectory: HandObjectTrajectory, points: Mapping[str, np.ndarray]
) -> dict[str, torch.Tensor]:
    stored: dict[str, torch.Tensor] = {}
    for entity in ENTITIES:
        if f"v3d_c.{entity}" not in points:
            continue
        faces = trajectory.object_faces if entity == "object" else trajectory.faces.get(entity)
        if faces is None:
            raise InputError(f"{where}: faces.{entity}: expected the faces of a mesh, found none")
        n_verts = points[f"v3d_c.{entity}"].shape[1]
        dtype = np.int16 if n_verts <= np.iinfo(np.int16).max + 1 else np.int32
        if len(faces) and (np.min(faces) < 0 or np.max(faces) >= n_verts):
            raise InputError(
                f"{where}: faces.{entity}: expected indices below {n_verts}, found {int(np.max(faces))}"
            )
        stored[entity] = torch.from_numpy(np.asarray(faces).astype(dtype))
    return stored


def _read(path: Path) -> dict[str, Any]:
    with open_regular(path, "a challenge prediction file") as stream:
        return _parse(str(path), stream)


def _parse(where: str, stream: BinaryIO) -> dict[str, Any]:
    content = load_torch(where, stream, "plain containers and tensors")
    if not isinstance(content, dict):
        raise InputError(f"{where}: expected a dictionary, found {type(content).__name__}")
    try:
        flat = dict(_flat(content))
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    if "faces" in flat:
        raise InputError(f"{where}: faces: expected a dictionary, found {type(flat['faces']).__name__}")
    faces = {key.removeprefix("faces."): flat.pop(key) for key in list(flat) if key.startswith("faces.")}
    return {**flat, "faces": faces}


def _flat(content: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of nested dictionaries under dotted keys, which is how the challenge spells them."""
    for key, value in content.items():
        if not isinstance(key, str):
            raise InputError(f"expected texts as keys, found {shown(key)}")
        if isinstance(value, dict) and prefix.count(".") >= _DEEPEST:
            raise InputError(f"expected dictionaries at most {_DEEPEST} deep, found more in {prefix[:80]}")
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _entities(content: Mapping[str, Any]) -> list[str]:
    return [entity for entity in ENTITIES if f"root.{entity}" in content or f"v3d_c.{entity}" in content]


def _shapes(
    present: Sequence[str], frames: int, n_verts: Mapping[str, int | str]
) -> dict[str, tuple[int | str, ...]]:
    """Every key of a clip with these entities and the shape it must have."""
    shapes: dict[str, tuple[int | str, ...]] = {}
    for entity in present:
        mesh = (frames, n_verts.get(entity, "V"), 3)
        shapes |= {f"root.{entity}": (frames, 3), f"v3d_c.{entity}": mesh}
        if entity == "object":
            relative = ("v3d_ra", "verts", *(f"v3d_{side}" for side in SIDES if side in present))
            shapes |= {f"{group}.object": mesh for group in relative}
        else:
            shapes |= {f"{group}.{entity}": (frames, 21, 3) for group in ("j3d_c", "j3d_ra")}
            shapes["v_posed.left" if entity == "left" else "verts.right"] = mesh
    return shapes


def _check(where: str, content: Mapping[str, Any]) -> None:
    """Check the content: names, shapes, finite values, faces in range, points relative to their roots."""
    for key, kind in (("fnames", list), ("full_seq_name", str)):
        if not isinstance(content.get(key), kind):
            raise InputError(f"{where}: {key}: expected a {kind.__name__}, found {shown(content.get(key))}")
    check_name(f"{where}: full_seq_name", content["full_seq_name"])
    for name in content["fnames"]:
        check_path(f"{where}: fnames", name)
    present = _entities(content)
    if not present:
        raise InputError(f"{where}: expected at least one of root.right, root.left, root.object, found none")
    frames = len(content["fnames"])
    n_verts = {
        entity: content[f"v3d_c.{entity}"].shape[1]
        for entity in present
        if getattr(content.get(f"v3d_c.{entity}"), "ndim", 0) == 3
    }
    for key, shape in _shapes(present, frames, n_verts).items():
        if key not in content:
            continue
        if not isinstance(content[key], torch.Tensor):
            raise InputError(f"{where}: {key}: expected a tensor, found {type(content[key]).__name__}")
        check_shape(f"{where}: {key}", content[key], shape)
        check_finite(f"{where}: {key}", content[key])
    for node, faces in content["faces"].items():
        if not isinstance(faces, torch.Tensor) or faces.is_floating_point():
            raise InputError(f"{where}: faces.{node}: expected an integer tensor, found {shown(faces)}")
        check_shape(f"{where}: faces.{node}", faces, ("F", 3))
        if node not in n_verts or not faces.numel():
            continue
        if faces.min() < 0 or faces.max() >= n_verts[node]:
            raise InputError(
                f"{where}: faces.{node}: expected indices from 0 to {n_verts[node] - 1}, "
                f"found {int(faces.min())} to {int(faces.max())}"
            )
    _check_roots(where, content)


def _check_types(where: str, content: Mapping[str, Any]) -> None:
    """Points are float16 and faces int16, or int32 where int16 cannot count the vertices."""
    for key, values in content.items():
        if isinstance(values, torch.Tensor) and values.dtype != torch.float16:
            raise InputError(f"{where}: {key}: expected float16, found {_type(values)}")
    for node, faces in content["faces"].items():
        verts = content.get(f"v3d_c.{node}")
        large = verts is not None and verts.shape[1] > np.iinfo(np.int16).max + 1
        expected = "int32" if large else "int16"
        if _type(faces) != expected:
            raise InputError(f"{where}: faces.{node}: expected {expected}, found {_type(faces)}")


def _type(values: torch.Tensor) -> str:
    return str(values.dtype).removeprefix("torch.")


def _check_roots(where: str, content: Mapping[str, Any]) -> None:
    pairs = [(f"j3d_ra.{side}", f"j3d_c.{side}", f"root.{side}") for side in SIDES]
    pairs += [(f"v3d_{side}.object", "v3d_c.object", f"root.{side}") for side in SIDES]
    pairs.append(("v3d_ra.object", "v3d_c.object", "root.object"))
    for relative, absolute, root in pairs:
        if not {relative, absolute, root} <= content.keys():
            continue
        expected = content[absolute].double() - content[root].double()[:, None]
        difference = (content[relative].double() - expected).abs().max().item() if expected.numel() else 0.0
        # All three are rounded to float16; the root of a distant hand has the coarsest steps.
        size = max(content[key].abs().max().item() for key in (absolute, root)) if expected.numel() else 0.0
        if difference > _HALF_TOLERANCE * max(1.0, size):
            raise InputError(
                f"{where}: {relative}: expected {absolute} minus {root}, "
                f"found a difference of {difference:.3g} m"
            )

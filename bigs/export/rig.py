"""Hands that bend and an object that moves, as one animated glTF: skinned meshes, for Blender and engines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bigs.export.gltf import Gltf, linear_color
from bigs.geometry.mesh import vertex_normals
from bigs.geometry.rotations import matrix_to_quat
from bigs.types import Side

# Viewers read four bones per vertex.
_BONES_PER_VERTEX = 4
# Pose correctives are written with as many shapes as keep every vertex within this distance, metres.
_SHAPE_TOLERANCE = 1e-4
# Half a turn about x: from OpenCV's axes to glTF's, x y z w.
_HALF_TURN = [1.0, 0.0, 0.0, 0.0]


@dataclass(frozen=True)
class SkinnedHand:
    """A hand of its own side (nothing is mirrored), K joints, OpenCV camera axes, metres."""

    verts: np.ndarray  # [V, 3] at rest, or [T, V, 3] when pose correctives make it differ from frame to frame
    faces: np.ndarray  # [F, 3]
    colors: np.ndarray  # [V, 3] in [0, 1]
    lbs_weights: np.ndarray  # [V, K]
    rest_joints: np.ndarray  # [K, 3]
    parents: tuple[int, ...]  # K, root -1
    joint_names: tuple[str, ...]  # K
    rotations: np.ndarray  # [T, K, 3, 3], each relative to its parent
    wrist: np.ndarray  # [T, 3] where joint 0 is


@dataclass(frozen=True)
class RigidMesh:
    """An object: `x_cam = rotations (scale * x) + transl`."""

    verts: np.ndarray  # [V, 3]
    faces: np.ndarray  # [F, 3]
    colors: np.ndarray  # [V, 3] in [0, 1]
    rotations: np.ndarray  # [T, 3, 3]
    transl: np.ndarray  # [T, 3]
    scale: float


class _Track:
    """Channels of one animation; all share their times."""

    def __init__(self, document: Gltf, frames: int, fps: float) -> None:
        self._document = document
        self._times = document.array((np.arange(frames) / fps).astype("<f4"), bounds=True)
        self._samplers: list[dict[str, Any]] = []
        self._channels: list[dict[str, Any]] = []

    def move(self, node: int, path: str, values: np.ndarray) -> None:
        output = self._document.array(values.astype("<f4"))
        self._samplers.append({"input": self._times, "output": output, "interpolation": "LINEAR"})
        target = {"node": node, "path": path}
        self._channels.append({"sampler": len(self._samplers) - 1, "target": target})

    def finish(self) -> None:
        self._document.add("animations", name="clip", samplers=self._samplers, channels=self._channels)


def save_rig(
    path: str | Path,
    hands: Mapping[Side, SkinnedHand],
    obj: RigidMesh | None,
    *,
    K: np.ndarray,
    width: int,
    height: int,
    fps: float,
) -> None:
    """Write an animated .glb with glTF's axes (y up) and the clip's camera; `path` is whole or absent.

    The camera has the clip's vertical angle, but its axis is in the middle of the picture: glTF knows no
    principal point.

    Args:
        path: the .glb file.
        hands: by side.
        obj: the object, if there is one.
        K: [3, 3] of the clip's camera, with its `width` and `height` in pixels.
        fps: frames a second.
    """
    document = Gltf()
    frames = len(obj.transl if obj is not None else next(iter(hands.values())).wrist)
    track = _Track(document, frames, fps)
    material = document.add(
        "materials", pbrMetallicRoughness={"metallicFactor": 0.0, "roughnessFactor": 0.8}, doubleSided=True
    )
    children, roots = [], []
    for name, hand in hands.items():
        joints = _add_joints(document, track, name, hand)
        children.append(joints[0])
        roots.append(_add_skin(document, track, name, hand, joints, material))
    if obj is not None:
        children.append(_add_object(document, track, obj, material))
    # A skinned mesh follows its joints whatever its node says, so it stays outside.
    turned = document.add("nodes", name="clip", rotation=_HALF_TURN, children=children)
    lens = {"yfov": float(2.0 * np.arctan(0.5 * height / K[1, 1])), "znear": 0.01}
    camera = document.add("cameras", type="perspective", perspective=lens | {"aspectRatio": width / height})
    eye = document.add("nodes", name="camera", camera=camera)
    document.add("scenes", nodes=[turned, eye, *roots])
    track.finish()
    document.save(path)


def _add_joints(document: Gltf, track: _Track, name: str, hand: SkinnedHand) -> list[int]:
    """A node for each joint, parents before children; the first has the hand's place and motion."""
    joints: list[int] = []
    offsets = hand.rest_joints - hand.rest_joints[np.maximum(hand.parents, 0)]
    offsets[0] = hand.rest_joints[0]
    for joint, offset in enumerate(offsets):
        node = document.add(
            "nodes", name=f"{name} {hand.joint_names[joint]}", translation=offset.astype(float).tolist()
        )
        track.move(node, "rotation", _quats(hand.rotations[:, joint]))
        joints.append(node)
    for joint, node in enumerate(joints):
        below = [joints[k] for k, parent in enumerate(hand.parents) if k > 0 and parent == joint]
        if below:
            document.amend("nodes", node, children=below)
    track.move(joints[0], "translation", hand.wrist)
    return joints


def _add_skin(
    document: Gltf, track: _Track, name: str, hand: SkinnedHand, joints: list[int], material: int
) -> int:
    rest = hand.verts if hand.verts.ndim == 2 else hand.verts.mean(0)
    bones = np.argsort(-hand.lbs_weights, axis=1, kind="stable")[:, :_BONES_PER_VERTEX]
    weights = np.take_along_axis(hand.lbs_weights, bones, axis=1)
    weights = weights / weights.sum(1, keepdims=True)
    attributes = _surface(document, rest, hand.faces, hand.colors)
    attributes |= {
        "JOINTS_0": document.bytes_per_vertex(np.where(weights > 0, bones, 0)),
        "WEIGHTS_0": document.vertices(weights),
    }
    primitive: dict[str, Any] = {
        "attributes": attributes,
        "indices": document.indices(hand.faces),
        "material": material,
    }
    shapes, amounts = _shapes(hand.verts)
    if len(shapes):
        primitive["targets"] = [{"POSITION": document.vertices(shape, bounds=True)} for shape in shapes]
    mesh = document.add("meshes", name=f"{name} hand", primitives=[primitive])
    to_joint = np.broadcast_to(np.eye(4), (len(joints), 4, 4)).copy()
    to_joint[:, :3, 3] = -hand.rest_joints
    skin = document.add(
        "skins",
        joints=joints,
        skeleton=joints[0],
        inverseBindMatrices=document.array(to_joint.astype("<f4")),
    )
    node = document.add("nodes", name=f"{name} hand", mesh=mesh, skin=skin)
    if len(shapes):
        track.move(node, "weights", amounts.reshape(-1))
    return node


def _add_object(document: Gltf, track: _Track, obj: RigidMesh, material: int) -> int:
    primitive = {
        "attributes": _surface(document, obj.verts, obj.faces, obj.colors),
        "indices": document.indices(obj.faces),
        "material": material,
    }
    mesh = document.add("meshes", name="object", primitives=[primitive])
    node = document.add("nodes", name="object", mesh=mesh, scale=[obj.scale] * 3)
    track.move(node, "rotation", _quats(obj.rotations))
    track.move(node, "translation", obj.transl)
    return node


def _surface(document: Gltf, verts: np.ndarray, faces: np.ndarray, colors: np.ndarray) -> dict[str, int]:
    return {
        "POSITION": document.vertices(verts, bounds=True),
        "NORMAL": document.vertices(_unit(vertex_normals(verts, faces))),
        "COLOR_0": document.vertices(linear_color(colors)),
    }


def _unit(normals: np.ndarray) -> np.ndarray:
    """Normals of length one, as glTF demands; those of vertices without faces point anywhere."""
    return np.where(np.linalg.norm(normals, axis=1, keepdims=True) > 0.5, normals, [0.0, 0.0, 1.0])


def _quats(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions [T, 4] x y z w of [T, 3, 3], neighbours on the same side, for interpolation."""
    quats = matrix_to_quat(torch.as_tensor(rotations).double()).numpy()
    flips = np.where((quats[1:] * quats[:-1]).sum(1) < 0, -1.0, 1.0)
    quats[1:] *= np.cumprod(flips)[:, None]
    return np.roll(quats, -1, axis=1)


def _shapes(verts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rest meshes that change, [T, V, 3], as few shapes [M, V, 3] on their mean, and amounts [T, M]."""
    if verts.ndim == 2:
        return np.zeros((0, *verts.shape)), np.zeros((0, 0))
    frames, count = verts.shape[:2]
    offsets = (verts - verts.mean(0)).reshape(frames, -1).astype(np.float64)
    left, spread, right = np.linalg.svd(offsets, full_matrices=False)
    amounts = left * spread
    for number in range(len(spread) + 1):
        error = (offsets - amounts[:, :number] @ right[:number]).reshape(frames, count, 3)
        if np.linalg.norm(error, axis=-1).max() < _SHAPE_TOLERANCE:
            break
    return right[:number].reshape(number, count, 3), amounts[:, :number]

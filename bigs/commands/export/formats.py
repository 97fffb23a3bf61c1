"""A finished scene in every export format."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.spatial
import torch
from torch import Tensor

from bigs.checks import InputError, check_choice
from bigs.commands.folder.contents import SCENE
from bigs.data.base import Clip
from bigs.export.challenge import write_challenge
from bigs.export.conventions import save_arctic, save_mano
from bigs.export.mesh import save_mesh, save_meshes
from bigs.export.ply import save_splats
from bigs.export.poses import ClipPoses, HandPoses, ObjectPoses, save_poses
from bigs.export.recording import Moment, save_recording
from bigs.export.rig import RigidMesh, SkinnedHand, save_rig
from bigs.export.splat_glb import save_splat_glb
from bigs.export.spz import save_spz
from bigs.geometry.rotations import matrix_to_axis_angle
from bigs.hand import JOINT_NAMES, MANO_PARENTS, mirror_axis_angle, mirror_points, mirror_rotation
from bigs.models.playback import Playback
from bigs.models.playback_file import save_playback
from bigs.models.repose import wrist_of
from bigs.types import Entity, Gaussians, Side


@dataclass(frozen=True)
class Choice:
    """What to write of a scene."""

    frames: tuple[int, ...] | None = None  # the times that are wanted; None is the format's own choice
    clip: Clip | None = None  # for formats that hold the input images


def write_outputs(run: Path, playback: Playback) -> None:
    """Write the scene and every format that a run has by default."""
    save_playback(run / SCENE, playback)
    for name in ("ply", "poses", "challenge", "mesh"):
        write_format(run, playback, name)


def write_format(folder: Path, playback: Playback, name: str, choice: Choice = Choice()) -> list[Path]:
    """Write one of `FORMATS` below `folder`; returns the files: none for an absent entity.

    Raises:
        InputError: unknown format, frames that the clip has not or the format does not take, or a package
            that is not installed.
    """
    check_format(playback, name, choice)
    return list(_WRITERS[name](folder, playback, choice))


def check_format(playback: Playback, name: str, choice: Choice) -> None:
    """Check what `write_format` can know before it writes.

    Raises:
        InputError: unknown format, or frames that the clip has not or the format does not take.
    """
    check_choice("format", name, FORMATS)
    if choice.frames is not None:
        if name not in OF_FRAMES:
            raise InputError(f"frames: expected one of the formats {', '.join(OF_FRAMES)}, found {name}")
        for frame in choice.frames:
            if not 0 <= frame < len(playback):
                raise InputError(f"frames: expected numbers from 0 to {len(playback) - 1}, found {frame}")


def _ready(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _write_ply(folder: Path, playback: Playback, choice: Choice) -> Iterable[Path]:
    if choice.frames is not None:
        for frame in choice.frames:
            path = _ready(folder / "gaussians" / f"frame_{frame:04d}.ply")
            save_splats(path, _one(playback.gaussians([frame])))
            yield path
        return
    names: dict[Entity, str] = {"right": "hand", "left": "hand", "object": "object"}
    if not playback.shares_hand:
        names["left"] = "hand_left"
    for entity, name in names.items():
        # One canonical hand that serves both sides is written once.
        if entity in playback.entities and not (
            entity == "left" and "right" in playback.hands and playback.shares_hand
        ):
            path = _ready(folder / "gaussians" / f"{name}.ply")
            save_splats(path, playback.canonical(entity))
            yield path


def _write_spz(folder: Path, playback: Playback, choice: Choice) -> Iterable[Path]:
    for frame in _frames(playback, choice):
        path = _ready(folder / "gaussians" / f"frame_{frame:04d}.spz")
        save_spz(path, _one(playback.gaussians([frame])))
        yield path


def _write_splat_glb(folder: Path, playback: Playback, choice: Choice) -> Iterable[Path]:
    for frame in _frames(playback, choice):
        path = _ready(folder / "gaussians" / f"frame_{frame:04d}.glb")
        parts = {entity: _one(playback.gaussians([frame], [entity])) for entity in playback.entities}
        save_splat_glb(path, parts)
        yield path


def _write_poses(folder: Path, playback: Playback, choice: Choice) -> Iterable[Path]:
    path = _ready(folder / "poses.npz")
    save_poses(path, _poses(playback))
    yield path


def _write_mano(folder: Path, playback: Playback, choice: Choice) -> Iterable[Path]:
    if not playback.hands:
        return
    flat = {side: matrix_to_axis_angle(hand.hand_pose) for side, hand in playback.hands.items()}
    path = _ready(folder / "mano.npz")
    save_mano(
        path,
        _poses(playback),
        {side: (mirror_axis_angle(v) if side == "left" else v).numpy() for side, v in flat.items()},
        {side: hand.joints.numpy() for side, hand in playback.hands.items()},
    )
    yield path


def _write_arctic(folder: Path, playback: Playback, choice: Choice) -> Iterable[Path]:
    path = _ready(folder / "arctic.npz")
    save_arctic(path, _poses(playback), width=playback.width, height=playback.height)
    yield path


def _write_challenge(folder: Path, playback: Playback, choice: Choice) -> Iterable[Path]:
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


def _write_object_mesh(folder: Path, playback: Playback, choice: Choice) -> Iterable[Path]:
    if playback.object is not None:
        path = _ready(folder / "meshes" / "object.ply")
        obj = playback.object
        save_mesh(path, (obj.scale * obj.verts).numpy(), obj.faces.numpy())
        yield path


def _write_hand_meshes(folder: Path, playback: Playback, choice: Choice) -> Iterable[Path]:
    every = range(len(playback)) if choice.frames is None else choice.frames
    for side, hand in playback.hands.items():
        for frame in every:
            path = _ready(folder / "meshes" / f"{side}_{frame:04d}.ply")
            save_mesh(path, hand.verts[frame].numpy(), hand.faces.numpy())
            yield path


def _write_obj(folder: Path, playback: Playback, choice: Choice) -> Iterable[Path]:
    colors: dict[str, np.ndarray] = {entity: _vertex_colors(playback, entity) for entity in playback.entities}
    for frame in _frames(playback, choice):
        path = _ready(folder / "meshes" / f"frame_{frame:04d}.obj")
        save_meshes(path, _meshes(playback, frame), colors)
        yield path


def _write_rig(folder: Path, playback: Playback, choice: Choice) -> Iterable[Path]:
    obj = None
    if playback.object is not None:
        o = playback.object
        obj = RigidMesh(
            verts=o.verts.numpy(),
            faces=o.faces.numpy(),
            colors=_vertex_colors(playback, "object"),
            rotations=o.rotations.numpy(),
            transl=o.centers.numpy(),
            scale=float(o.scale),
        )
    path = _ready(folder / "scene.glb")
    hands = {side: _rigged(playback, side) for side in playback.hands}
    K, width, height = playback.K.numpy(), playback.width, playback.height
    save_rig(path, hands, obj, K=K, width=width, height=height, fps=playback.fps)
    yield path


def _write_recording(folder: Path, playback: Playback, choice: Choice) -> Iterable[Path]:
    def moment(frame: int) -> Moment:
        return Moment(
            {entity: _one(playback.gaussians([frame], [entity])) for entity in playback.entities},
            _meshes(playback, frame),
            None if choice.clip is None else choice.clip.image(frame),
        )

    path = _ready(folder / f"{playback.name}.rrd")
    K, width, height = playback.K.numpy(), playback.width, playback.height
    moments = map(moment, range(len(playback)))
    save_recording(path, playback.name, moments, K=K, width=width, height=height)
    yield path


def _frames(playback: Playback, choice: Choice) -> Sequence[int]:
    """The frames that are wanted; the middle one if none is named."""
    return (len(playback) // 2,) if choice.frames is None else choice.frames


def _one(gaussians: Gaussians) -> Gaussians:
    """One frame [1, N, ...] without its batch axis, in colours that a file can hold."""
    colors = gaussians.colors[0] if gaussians.colors.ndim == 3 else gaussians.colors
    return gaussians._replace(means=gaussians.means[0], quats=gaussians.quats[0], colors=colors.clamp(0, 1))


def _meshes(playback: Playback, frame: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    trajectory = playback.at([frame]).trajectory()
    meshes = {str(side): (verts[0], trajectory.faces[side]) for side, verts in trajectory.verts.items()}
    if trajectory.object_verts is not None and trajectory.object_faces is not None:
        meshes["object"] = (trajectory.object_verts[0], trajectory.object_faces)
    return meshes


def _poses(playback: Playback) -> ClipPoses:
    hands = {
        side: HandPoses(
            hand.global_orient_aa.numpy(),
            hand.hand_pose_aa.numpy(),
            hand.transl.numpy(),
            hand.betas.numpy(),
            hand.grasp.numpy(),
            hand.grasp_certainty.numpy(),
        )
        for side, hand in playback.hands.items()
    }
    obj = None
    if playback.object is not None:
        o = playback.object
        obj = ObjectPoses(o.rotations.numpy(), o.centers.numpy(), float(o.scale))
    return ClipPoses(playback.frame_names, playback.K.numpy(), hands, obj)


def _rigged(playback: Playback, side: Side) -> SkinnedHand:
    """A hand on its own side: what is stored of the canonical hand is mirrored for a left one."""
    hand = playback.hands[side]
    orient, wrist = wrist_of(hand)
    rotations, rest_joints = torch.cat([orient[:, None], hand.hand_pose], dim=1), hand.rest_joints
    if side == "left":
        rotations, rest_joints, wrist = (
            mirror_rotation(rotations),
            mirror_points(rest_joints),
            mirror_points(wrist),
        )
    joints = len(MANO_PARENTS)
    return SkinnedHand(
        verts=hand.v_posed.numpy(),
        faces=hand.faces.numpy(),
        colors=_vertex_colors(playback, side),
        lbs_weights=hand.lbs_weights.numpy(),
        rest_joints=rest_joints.numpy(),
        parents=MANO_PARENTS,
        joint_names=JOINT_NAMES[:joints],
        rotations=rotations.numpy(),
        wrist=wrist.numpy(),
    )


def _vertex_colors(playback: Playback, entity: Entity) -> np.ndarray:
    """The colours of an entity's vertices, [V, 3], without the light of any frame."""
    if entity == "object":
        assert playback.object is not None
        verts = playback.object.verts
    else:
        v_posed = playback.hands[entity].v_posed
        verts = v_posed if v_posed.ndim == 2 else v_posed.mean(0)
        verts = mirror_points(verts) if entity == "left" else verts
    canonical = playback.canonical(entity)
    return _surface_colors(verts, canonical.means, canonical.colors).numpy()


def _surface_colors(verts: Tensor, means: Tensor, colors: Tensor) -> Tensor:
    """Each vertex gets the mean colour of the Gaussians nearest to it: [V, 3]."""
    near = min(4, len(means))
    _, index = scipy.spatial.cKDTree(means.numpy()).query(verts.numpy(), k=near)
    return colors[torch.as_tensor(index).reshape(len(verts), near)].mean(1).clamp(0, 1)


_WRITERS: dict[str, Callable[[Path, Playback, Choice], Iterable[Path]]] = {
    "ply": _write_ply,
    "spz": _write_spz,
    "splat-glb": _write_splat_glb,
    "glb": _write_rig,
    "obj": _write_obj,
    "mesh": _write_object_mesh,
    "hand-meshes": _write_hand_meshes,
    "rerun": _write_recording,
    "poses": _write_poses,
    "mano": _write_mano,
    "arctic": _write_arctic,
    "challenge": _write_challenge,
}
FORMATS = tuple(_WRITERS)
# Those that can be written for chosen frames.
OF_FRAMES = ("ply", "spz", "splat-glb", "obj", "hand-meshes")

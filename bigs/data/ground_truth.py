"""Ground truth of a clip: `gt.npz` and, beside it, the true object as `gt_object.ply`.

All is in the OpenCV camera frame of its time, metres: hand vertices are LBS(pose, betas) + trans, object
points obj_R (obj_scale x) + obj_t for x of `gt_object.ply`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from bigs.archives import read_npz
from bigs.checks import InputError, check_faces, check_pixels, check_product, check_rotations
from bigs.data.base import HandTrack
from bigs.data.entries import array_entry, positive_entry, require
from bigs.data.formats.annotation import Annotation, ObjectTruth
from bigs.data.meshes import check_solid, read_mesh
from bigs.files import read_text
from bigs.names import check_name
from bigs.types import SIDES, HandObjectTrajectory, Side

OBJECT_FILE = "gt_object.ply"
# From a child's fist to the largest spread hand, with a margin.
SHORTEST_HAND_M, LONGEST_HAND_M = 0.02, 0.6


def load_ground_truth(path: str | Path) -> HandObjectTrajectory:
    """Read the true joints and meshes of a clip.

    Args:
        path: `gt.npz`, or the clip folder that holds it.

    Returns:
        The trajectory; frames are named by `build/corres.txt` when the clip has one.

    Raises:
        InputError: a missing or damaged file or field, fields that disagree about the number of frames, or a
            truth that cannot be: matrices that are no rotations, an object or hand without extent.
    """
    path = Path(path)
    file = path / "gt.npz" if path.is_dir() else path
    arrays = read_npz(file, "ground truth")
    present = [side for side in SIDES if f"{side}_verts" in arrays]
    has_object = "obj_R" in arrays
    if not present and not has_object:
        raise InputError(
            f"{file}: expected right_verts, left_verts or obj_R, found {', '.join(arrays) or 'nothing'}"
        )
    first = f"{present[0]}_verts" if present else "obj_R"
    frames = len(_field(file, arrays, first, ("T", "V" if present else 3, 3)))
    if not frames:
        raise InputError(f"{file}: {first}: expected at least one frame, found none")

    verts: dict[Side, np.ndarray] = {}
    joints: dict[Side, np.ndarray] = {}
    faces: dict[Side, np.ndarray] = {}
    for side in present:
        verts[side] = _field(file, arrays, f"{side}_verts", (frames, "V", 3))
        joints[side] = _field(file, arrays, f"{side}_joints", (frames, 21, 3))
        for key, points in ((f"{side}_verts", verts[side]), (f"{side}_joints", joints[side])):
            _check_hand_size(f"{file}: {key}", points)
        faces[side] = _read_faces(file, arrays, f"{side}_faces", verts[side].shape[1])
    object_verts, object_faces = _read_object(file, arrays, frames) if has_object else (None, None)
    return HandObjectTrajectory(
        name=file.resolve().parent.name,
        frame_names=_frame_names(file, frames),
        joints=joints,
        verts=verts,
        faces=faces,
        object_verts=object_verts,
        object_faces=object_faces,
    )


def load_annotation(path: str | Path) -> Annotation:
    """The same file as poses, from which other layouts are written; its world is the camera.

    Args:
        path: `gt.npz`, or the clip folder that holds it.

    Raises:
        InputError: as `load_ground_truth`.
    """
    path = Path(path)
    file = path / "gt.npz" if path.is_dir() else path
    arrays = read_npz(file, "ground truth")
    K = _field(file, arrays, "K", (3, 3))
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InputError(f"{file}: K: expected positive focal lengths, found {K[0, 0]:g} and {K[1, 1]:g}")
    size = _field(file, arrays, "wh", (2,))
    if size.min() < 1 or (size != np.floor(size)).any():
        raise InputError(f"{file}: wh: expected a width and a height in pixels, found {size.tolist()}")
    width, height = map(int, size)
    check_pixels(f"{file}: wh", width, height)
    hands: dict[Side, HandTrack] = {}
    frames: int | str = "T"
    for side in SIDES:
        if f"{side}_pose" in arrays:
            poses = _field(file, arrays, f"{side}_pose", (frames, 48)).reshape(-1, 16, 3)
            frames = len(poses)
            hands[side] = HandTrack(
                global_orient=poses[:, 0],
                hand_pose=poses[:, 1:],
                transl=_field(file, arrays, f"{side}_trans", (frames, 3)),
                betas=_field(file, arrays, f"{side}_betas", (10,)),
                valid=np.ones(frames, dtype=bool),
            )
    obj = None
    if "obj_R" in arrays:
        rotations, transl, scale = _object_poses(file, arrays, frames)
        frames = len(rotations)
        verts, faces = _read_mesh(file, scale)
        check_product(f"{file}: {OBJECT_FILE}", frames, len(verts))
        obj = ObjectTruth(verts, faces, rotations, transl, np.ones(frames, dtype=bool))
    if not isinstance(frames, int) or not frames:
        raise InputError(f"{file}: expected right_pose, left_pose or obj_R, found {', '.join(arrays)}")
    return Annotation(
        name=file.resolve().parent.name,
        frame_names=_frame_names(file, frames),
        width=width,
        height=height,
        K=K,
        cam_from_world=np.repeat(np.eye(4)[None], frames, axis=0),
        hands=hands,
        object=obj,
    )


def write_ground_truth(
    folder: str | Path, *, arrays: Mapping[str, Any], object_mesh: trimesh.Trimesh | None
) -> Path:
    """Write `gt.npz` from `arrays`, named as `load_ground_truth` reads them, and the true mesh."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(folder / "gt.npz", **arrays)
    if object_mesh is not None:
        object_mesh.export(folder / OBJECT_FILE)
    return folder / "gt.npz"


def _object_poses(
    file: Path, arrays: Mapping[str, np.ndarray], frames: int | str
) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotations [T, 3, 3], translations [T, 3] and the scale."""
    rotations = _field(file, arrays, "obj_R", (frames, 3, 3))
    check_rotations(f"{file}: obj_R", rotations)
    transl = _field(file, arrays, "obj_t", (len(rotations), 3))
    scale = positive_entry(f"{file}: obj_scale", arrays["obj_scale"]) if "obj_scale" in arrays else 1.0
    return rotations, transl, scale


def _read_mesh(file: Path, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """The object's vertices [V, 3] in metres, and its faces [F, 3]."""
    mesh_file = file.parent / OBJECT_FILE
    verts, faces = read_mesh(mesh_file)
    check_solid(f"{mesh_file} (times obj_scale {scale:g})", scale * verts, faces)
    return scale * verts, faces


def _read_object(file: Path, arrays: Mapping[str, np.ndarray], frames: int) -> tuple[np.ndarray, np.ndarray]:
    rotations, transl, scale = _object_poses(file, arrays, frames)
    own, faces = _read_mesh(file, scale)
    check_product(f"{file}: {OBJECT_FILE}", len(rotations), len(own))
    return np.einsum("tij,nj->tni", rotations, own) + transl[:, None], faces


def _check_hand_size(where: str, points: np.ndarray) -> None:
    """A hand that has no extent has no pose either."""
    sizes = np.ptp(points, axis=1).max(axis=1) if points.shape[1] else np.zeros(len(points))
    wrong = (sizes < SHORTEST_HAND_M) | (sizes > LONGEST_HAND_M)
    if wrong.any():
        t = int(np.flatnonzero(wrong)[0])
        raise InputError(
            f"{where}: expected a hand of {SHORTEST_HAND_M:g} to {LONGEST_HAND_M:g} m, found one of "
            f"{sizes[t]:.3g} m in frame {t}"
        )


def _read_faces(file: Path, arrays: Mapping[str, np.ndarray], key: str, vertex_count: int) -> np.ndarray:
    faces = _field(file, arrays, key, ("F", 3))
    check_faces(f"{file}: {key}", faces, vertex_count)
    return faces.astype(np.int64)


def _frame_names(file: Path, frames: int) -> tuple[str, ...]:
    corres = file.parent / "build" / "corres.txt"
    names = read_text(corres, "a list of frame names").split() if corres.exists() else []
    if names and len(names) != frames:
        raise InputError(f"{file}: expected the {len(names)} frames that {corres} lists, found {frames}")
    return tuple(check_name(str(corres), name) for name in names) or tuple(f"{t:04d}" for t in range(frames))


def _field(
    file: Path, arrays: Mapping[str, np.ndarray], key: str, shape: tuple[int | str, ...]
) -> np.ndarray:
    return array_entry(f"{file}: {key}", require(f"{file}: {key}", arrays, key), shape)

"""HOLD's and the HANDS challenge's `build` folder: image/, mask/, corres.txt and data.npy, read and written.

With n = `normalize_shift` and F = diag(1, -1, -1), the world of such a clip is F x_cam + n: OpenGL axes,
metres, camera centre at n. `world_mat_i` is K [F | -F n]; `scale_mat_i` is the unit of HOLD's own space.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from bigs.checks import InputError, found_at
from bigs.data.base import Clip, HandTrack, ObjectTrack
from bigs.data.decoded import DecodedFrames
from bigs.data.entries import array_entry, mapping_entry, positive_entry, require
from bigs.data.frame_rate import rate_by_names
from bigs.data.images import (
    IMAGE_SUFFIXES,
    MASK_SUFFIXES,
    check_pairs,
    list_frames,
    read_image,
)
from bigs.data.projection import CAMERA_TOLERANCE, decompose_projection
from bigs.data.tracks import check_turns, fill_rotations, fill_vectors
from bigs.files import read_text
from bigs.names import check_name
from bigs.types import ENTITIES, SIDES, USUAL_FPS, Side
from bigs.unpickle import load_npy

GL_FROM_CV = np.diag([1.0, -1.0, -1.0])

# HOLD's defaults: with them the scaled space's unit is half the camera's distance from the origin.
SCENE_BOUNDING_SPHERE = 6.0
MAX_RADIUS_RATIO = 3.0
RADIUS_PER_SHIFT = MAX_RADIUS_RATIO / SCENE_BOUNDING_SPHERE


def load_hold(path: str | Path) -> Clip:
    """Read and check a clip.

    Args:
        path: a folder that is, or contains, `build/`.

    Returns:
        The clip; every image and mask has been decoded once, so later reads do not fail on a damaged file.

    Raises:
        InputError: one sentence naming file, field, expected and found.
    """
    folder = _build_folder(Path(path))
    file = folder / "data.npy"
    if not file.is_file():
        raise InputError(f"{file}: expected the clip's initial estimates, found no such file")
    image_paths = list_frames(folder / "image", IMAGE_SUFFIXES)
    mask_paths = list_frames(folder / "mask", MASK_SUFFIXES)
    frame_names = _frame_names(folder / "corres.txt", image_paths)
    check_pairs(image_paths, mask_paths)

    data = mapping_entry(str(file), load_npy(file))
    name = data.get("seq_name")
    nameless = name is None or (isinstance(name, str) and not name)
    name = check_name(f"{file}: seq_name", _sequence_name(folder) if nameless else name)
    frames = len(image_paths)
    height, width = read_image(image_paths[0]).shape[:2]
    K, cam_from_world, scene_scale = _read_cameras(file, data, frames, width)
    where = f"{file}: entities"
    entities = mapping_entry(where, require(where, data, "entities"))
    hands: dict[Side, HandTrack] = {
        side: _read_hand(f"{where}.{side}", entities[side], frames) for side in SIDES if side in entities
    }
    obj = _read_object(f"{where}.object", entities["object"], frames) if "object" in entities else None
    if not hands and obj is None:
        found = ", ".join(map(str, entities)) or "none"
        raise InputError(f"{where}: expected at least one of {', '.join(ENTITIES)}, found {found}")
    where = f"{file}: normalize_shift"
    normalize_shift = array_entry(where, require(where, data, "normalize_shift"), (3,))

    decoded = DecodedFrames()
    return Clip(
        name=name,
        folder=folder,
        frame_names=frame_names,
        image_paths=image_paths,
        mask_paths=mask_paths,
        width=width,
        height=height,
        K=K,
        cam_from_world=cam_from_world,
        hands=hands,
        object=obj,
        scene_scale=scene_scale,
        normalize_shift=normalize_shift,
        mask_areas=decoded.read_all(image_paths, mask_paths, (width, height)),
        decoded=decoded,
        # HOLD's own files do not say.
        fps=positive_entry(f"{file}: fps", data["fps"]) if "fps" in data else rate_by_names(frame_names),
    )


def write_hold(
    folder: str | Path,
    *,
    name: str,
    frame_names: Sequence[str],
    images: Iterable[np.ndarray],
    masks: Iterable[np.ndarray],
    K: np.ndarray,
    normalize_shift: np.ndarray,
    hands: Mapping[Side, HandTrack],
    object: ObjectTrack | None,
    fps: float = USUAL_FPS,
    torch_norm_mat: bool = True,
) -> Path:
    """Write `folder/build` as HOLD's preprocessing leaves it.

    Args:
        folder: clip folder; made if missing.
        name: sequence name.
        frame_names: T original names, for corres.txt.
        images: T arrays [H, W, 3] uint8.
        masks: T arrays [H, W] uint8 with the values of `bigs.types.MASK_VALUES`.
        K: [3, 3] intrinsics.
        normalize_shift: [3] metres; the tracks are in the world that it defines.
        hands: tracks of the hands that exist.
        object: the object's track.
        fps: frames a second.
        torch_norm_mat: store `norm_mat` as a torch tensor, as HOLD does, or as a numpy array.

    Returns:
        The `build` folder.
    """
    build = Path(folder) / "build"
    for sub, frames in (("image", images), ("mask", masks)):
        (build / sub).mkdir(parents=True, exist_ok=True)
        for t, frame in enumerate(frames):
            # The default level takes three times as long for files of the same size.
            Image.fromarray(frame).save(build / sub / f"{t:04d}.png", compress_level=4)
    (build / "corres.txt").write_text("".join(f"{line}\n" for line in frame_names))

    shift = np.asarray(normalize_shift, dtype=np.float64)
    world_mat = np.eye(4)
    world_mat[:3] = K @ np.hstack([GL_FROM_CV, -GL_FROM_CV @ shift[:, None]])
    radius = np.linalg.norm(shift) * RADIUS_PER_SHIFT
    scale_mat = np.diag([radius, radius, radius, 1.0]).astype(np.float32)
    entities: dict[str, dict[str, Any]] = {side: _hand_entity(track) for side, track in hands.items()}
    if object is not None:
        entities["object"] = _object_entity(object, torch_norm_mat)
    data = {
        "seq_name": name,
        "cameras": {
            key: value
            for t in range(len(frame_names))
            for key, value in ((f"scale_mat_{t}", scale_mat.copy()), (f"world_mat_{t}", world_mat.copy()))
        },
        "scene_bounding_sphere": SCENE_BOUNDING_SPHERE,
        "max_radius_ratio": MAX_RADIUS_RATIO,
        "entities": entities,
        "normalize_shift": shift,
        "fps": float(fps),
    }
    np.save(build / "data.npy", np.array(data, dtype=np.object_))
    return build


def shift_before(center_cam: np.ndarray) -> np.ndarray:
    """The `normalize_shift` [3] that puts a point of the camera's frame one metre before HOLD's camera."""
    return -GL_FROM_CV @ center_cam + np.array([0.0, 0.0, -1.0])


def _build_folder(path: Path) -> Path:
    if not path.is_dir():
        raise InputError(f"{path}: expected a clip folder, found {found_at(path)}")
    return path / "build" if (path / "build").is_dir() else path


def _sequence_name(folder: Path) -> str:
    folder = folder.resolve()
    return folder.parent.name if folder.name == "build" else folder.name


def _frame_names(file: Path, image_paths: Sequence[Path]) -> tuple[str, ...]:
    if not file.exists():
        return tuple(path.name for path in image_paths)
    lines = read_text(file, "a list of frame names").splitlines()
    names = tuple(
        check_name(f"{file}: line {number}", line.strip())
        for number, line in enumerate(lines, 1)
        if line.strip()
    )
    if len(names) != len(image_paths):
        raise InputError(
            f"{file}: expected one line for each of {len(image_paths)} images, found {len(names)}"
        )
    return names


def _read_cameras(
    file: Path, data: Mapping[str, Any], frames: int, width: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """K [3, 3], cam_from_world [T, 4, 4] and HOLD's scene scale from `world_mat_i` and `scale_mat_i`."""
    where = f"{file}: cameras"
    cameras = mapping_entry(where, require(where, data, "cameras"))
    stored = sum(1 for key in cameras if re.fullmatch(r"world_mat_\d+", str(key)))
    if stored != frames:
        raise InputError(f"{where}: expected a world_mat for each of {frames} images, found {stored}")
    intrinsics: list[np.ndarray] = []
    extrinsics: list[np.ndarray] = []
    for t in range(frames):
        matrix = f"{where}.world_mat_{t}"
        world_mat = array_entry(matrix, require(matrix, cameras, f"world_mat_{t}"), (4, 4))
        K, cam_from_world = decompose_projection(matrix, world_mat, width)
        if t and not np.allclose(K, intrinsics[0], rtol=0, atol=CAMERA_TOLERANCE * width):
            expected, found = (np.array2string(k, precision=6).replace("\n", "") for k in (intrinsics[0], K))
            raise InputError(f"{matrix}: expected the intrinsics of world_mat_0 {expected}, found {found}")
        intrinsics.append(K)
        extrinsics.append(cam_from_world)

    matrix = f"{where}.scale_mat_0"
    scale_mat = array_entry(matrix, require(matrix, cameras, "scale_mat_0"), (4, 4))
    radius = float(scale_mat[0, 0])
    if radius <= 0 or not np.allclose(scale_mat, np.diag([radius, radius, radius, 1.0])):
        raise InputError(f"{matrix}: expected diag(m, m, m, 1) with m > 0, found {scale_mat.tolist()}")
    return intrinsics[0], np.stack(extrinsics), 1.0 / radius


def _read_hand(where: str, entity: Any, frames: int) -> HandTrack:
    entity = mapping_entry(where, entity)
    valid = _read_valid(where, entity, frames)
    poses = _track(where, entity, "hand_poses", (frames, 48), valid)
    check_turns(f"{where}.hand_poses", poses.reshape(frames, 16, 3), valid)
    rotvecs = fill_rotations(poses.reshape(frames, 16, 3), valid)
    return HandTrack(
        global_orient=rotvecs[:, 0],
        hand_pose=rotvecs[:, 1:],
        transl=fill_vectors(_track(where, entity, "hand_trans", (frames, 3), valid), valid),
        betas=_entity_array(where, entity, "mean_shape", (10,)),
        valid=valid,
    )


def _read_object(where: str, entity: Any, frames: int) -> ObjectTrack:
    entity = mapping_entry(where, entity)
    valid = _read_valid(where, entity, frames)
    poses = _track(where, entity, "object_poses", (frames, 6), valid)
    points = _entity_array(where, entity, "pts.cano", ("N", 3))
    if len(points) == 0:
        raise InputError(f"{where}.pts.cano: expected at least one point, found none")
    if np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-6 * np.abs(points).max()) < 3:
        raise InputError(
            f"{where}.pts.cano: expected points that span a volume, found {len(points)} in a plane"
        )
    scale = positive_entry(f"{where}.obj_scale", require(f"{where}.obj_scale", entity, "obj_scale"))
    norm_mat = _entity_array(where, entity, "norm_mat", (4, 4))
    if not np.allclose(norm_mat[3], [0, 0, 0, 1]) or np.linalg.det(norm_mat[:3, :3]) < 1e-12:
        raise InputError(
            f"{where}.norm_mat: expected an invertible affine matrix that mirrors nothing, found "
            f"{norm_mat.tolist()}"
        )
    check_turns(f"{where}.object_poses", poses[:, :3], valid)
    return ObjectTrack(
        points=points,
        colors=_read_colors(f"{where}.pts.rgb", entity["pts.rgb"], len(points))
        if "pts.rgb" in entity
        else None,
        scale=scale,
        metric_from_canon=np.diag([scale, scale, scale, 1.0]) @ np.linalg.inv(norm_mat),
        rotations=Rotation.from_rotvec(fill_rotations(poses[:, None, :3], valid)[:, 0]).as_matrix(),
        transl=fill_vectors(poses[:, 3:], valid),
        valid=valid,
    )


def _read_colors(where: str, stored: Any, count: int) -> np.ndarray:
    """Colours [N, 3] in [0, 1] from bytes or from numbers that are in [0, 1] already."""
    is_bytes = np.asarray(stored).dtype == np.uint8
    colors = array_entry(where, stored, (count, 3)) / (255.0 if is_bytes else 1.0)
    if colors.min() < 0 or colors.max() > 1:
        raise InputError(
            f"{where}: expected uint8 or numbers in [0, 1], found {colors.min():.3g} to {colors.max():.3g}"
        )
    return colors


def _read_valid(where: str, entity: Mapping[str, Any], frames: int) -> np.ndarray:
    """`is_valid` as bool [T]; every frame is valid when the file does not say."""
    if "is_valid" not in entity:
        return np.ones(frames, dtype=bool)
    flags = array_entry(f"{where}.is_valid", entity["is_valid"], (frames,))
    if not np.isin(flags, (0, 1)).all():
        raise InputError(
            f"{where}.is_valid: expected 0 or 1 in every frame, found {flags[~np.isin(flags, (0, 1))][0]}"
        )
    if not flags.any():
        raise InputError(f"{where}.is_valid: expected at least one valid frame, found none of {frames}")
    return flags.astype(bool)


def _track(
    where: str, entity: Mapping[str, Any], key: str, shape: tuple[int, int], valid: np.ndarray
) -> np.ndarray:
    """A per-frame field [T, D], finite wherever `valid`."""
    values = _entity_array(where, entity, key, shape, finite=False)
    broken = np.flatnonzero(valid & ~np.isfinite(values).all(axis=1))
    if broken.size:
        value = values[broken[0]][~np.isfinite(values[broken[0]])][0]
        raise InputError(
            f"{where}.{key}: expected finite values in every valid frame, found {value} in frame {broken[0]}"
        )
    return values


def _entity_array(
    where: str, entity: Mapping[str, Any], key: str, shape: Sequence[int | str], *, finite: bool = True
) -> np.ndarray:
    return array_entry(f"{where}.{key}", require(f"{where}.{key}", entity, key), shape, finite=finite)


def _hand_entity(track: HandTrack) -> dict[str, Any]:
    poses = np.concatenate([track.global_orient[:, None], track.hand_pose], axis=1)
    return {
        "hand_poses": poses.reshape(len(poses), 48).astype(np.float32),
        "hand_trans": np.asarray(track.transl, dtype=np.float64),
        "mean_shape": np.asarray(track.betas, dtype=np.float32),
        **_valid_entry(track.valid),
    }


def _object_entity(track: ObjectTrack, torch_norm_mat: bool) -> dict[str, Any]:
    scale = track.scale
    norm_mat = np.linalg.inv(np.diag([1 / scale, 1 / scale, 1 / scale, 1.0]) @ track.metric_from_canon)
    entity = {
        "obj_scale": float(scale),
        "pts.cano": np.asarray(track.points, dtype=np.float64),
        "norm_mat": torch.from_numpy(norm_mat).float() if torch_norm_mat else norm_mat.astype(np.float32),
        "object_poses": np.hstack([Rotation.from_matrix(track.rotations).as_rotvec(), track.transl]),
        **_valid_entry(track.valid),
    }
    if track.colors is not None:
        entity["pts.rgb"] = (np.asarray(track.colors) * 255).round().astype(np.uint8)
    return entity


def _valid_entry(valid: np.ndarray) -> dict[str, Any]:
    """`is_valid` is our own addition to the format, so it appears only where it says something."""
    return {} if valid.all() else {"is_valid": valid.astype(np.uint8)}

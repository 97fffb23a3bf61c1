"""A folder as structure from motion leaves it, with a file of hands: COLMAP's or nerfstudio's.

    image/ or images/     frames
    mask/ or masks/       label masks of the same names
    sparse/0/             COLMAP model of the object (made from the object's pixels), text or binary; or
    transforms.json       the same as nerfstudio has it, with `ply_file_path`, the points
    hands.npz             per hand `right_global_orient` [T, 3], `right_hand_pose` [T, 15, 3], `right_transl`
                          [T, 3], `right_betas` [10], as poses.npz has them: OpenCV camera frame, metres.
                          Optional: `right_valid` [T], and `object_scale`, metres per unit of the points

The model's world is the object, so its cameras tell how the object moved in front of a still camera.
Frames that the model lacks are filled from their neighbours. Without `object_scale` the object is put as far
away as the hands are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from bigs.archives import read_npz
from bigs.checks import InputError, check_finite, check_rotations, shown
from bigs.colmap import pycolmap
from bigs.data.base import Clip, HandTrack, ObjectTrack
from bigs.data.decoded import DecodedFrames
from bigs.data.entries import array_entry, mapping_entry, positive_entry, require
from bigs.data.formats.colmap_files import check_model_files
from bigs.data.formats.hold import RADIUS_PER_SHIFT, shift_before
from bigs.data.formats.transforms import read_cameras
from bigs.data.frame_rate import rate_by_names
from bigs.data.images import (
    IMAGE_SUFFIXES,
    MASK_SUFFIXES,
    check_pairs,
    list_frames,
    read_image,
)
from bigs.data.mesh_files import load_mesh_file
from bigs.data.tracks import fill_rotations, fill_vectors
from bigs.files import read_json
from bigs.names import check_inside, check_name
from bigs.types import SIDES, Side

HANDS_FILE = "hands.npz"
TRANSFORMS_FILE = "transforms.json"
_IMAGE_FOLDERS = ("image", "images")
_MASK_FOLDERS = ("mask", "masks")
_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")
# Intrinsics of one camera that are stored per frame agree to this many pixels.
_K_TOLERANCE = 1e-3
# Of the image's side: a shorter focal length sees more than 179.8 degrees.
_LEAST_FOCAL = 1e-3


class SfmModel(NamedTuple):
    """The result of structure from motion, in its own unit."""

    K: np.ndarray  # [3, 3]
    poses: dict[str, np.ndarray]  # stem of an image -> [4, 4] model to camera, OpenCV axes
    points: np.ndarray  # [N, 3]
    colors: np.ndarray | None  # [N, 3] in [0, 1]


def is_sfm_folder(path: Path) -> bool:
    """Whether a folder has frames and a model of one of the two kinds."""
    has_images = any((path / name).is_dir() for name in _IMAGE_FOLDERS)
    return has_images and ((path / TRANSFORMS_FILE).is_file() or _model_folder(path) is not None)


def load_sfm_folder(path: str | Path) -> Clip:
    """Read and check such a folder; the clip's world is the camera.

    Raises:
        InputError: one sentence naming file, field, expected and found.
    """
    folder = Path(path)
    image_paths = list_frames(_first(folder, _IMAGE_FOLDERS), IMAGE_SUFFIXES)
    mask_paths = list_frames(_first(folder, _MASK_FOLDERS), MASK_SUFFIXES)
    check_pairs(image_paths, mask_paths)
    height, width = read_image(image_paths[0]).shape[:2]
    decoded = DecodedFrames()
    areas = decoded.read_all(image_paths, mask_paths, (width, height))
    model = _read_transforms(folder, (width, height))
    if model is None:
        model = _read_colmap(folder, (width, height))
    hands, scale = _read_hands(folder / HANDS_FILE, len(image_paths))
    track = _object_track(folder, model, [file.stem for file in image_paths], hands, scale)
    shift = shift_before(np.median(track.points_world().mean(axis=1), axis=0))
    return Clip(
        name=check_name(f"{folder}: name", folder.resolve().name),
        folder=folder,
        frame_names=tuple(file.name for file in image_paths),
        image_paths=image_paths,
        mask_paths=mask_paths,
        width=width,
        height=height,
        K=model.K,
        cam_from_world=np.repeat(np.eye(4)[None], len(image_paths), axis=0),
        hands=hands,
        object=track,
        scene_scale=1.0 / (RADIUS_PER_SHIFT * float(np.linalg.norm(shift))),
        normalize_shift=shift,
        mask_areas=areas,
        decoded=decoded,
        fps=rate_by_names([file.name for file in image_paths]),
    )


def _first(folder: Path, names: Sequence[str]) -> Path:
    """The first folder that is there, or else the first name, which is then missed by name."""
    return next((folder / name for name in names if (folder / name).is_dir()), folder / names[0])


def _model_folder(folder: Path) -> Path | None:
    places = (folder / name for name in _MODEL_FOLDERS)
    return next((p for p in places if any(p.glob("cameras.*")) and any(p.glob("images.*"))), None)


def _read_transforms(folder: Path, size: tuple[int, int]) -> SfmModel | None:
    """nerfstudio's file; None where there is none."""
    file = folder / TRANSFORMS_FILE
    if not file.is_file():
        return None
    cameras = read_cameras(file)
    poses = {}
    for camera in cameras:
        if (camera.width, camera.height) != size:
            raise InputError(
                f"{camera.where}: expected {size[0]} x {size[1]} as the images have, "
                f"found {camera.width} x {camera.height}"
            )
        if not np.allclose(camera.K, cameras[0].K, rtol=0, atol=_K_TOLERANCE):
            raise InputError(f"{camera.where}: expected the first frame's lens, found another")
        name = require(f"{camera.where}.file_path", camera.entry, "file_path")
        poses[Path(str(name)).stem] = camera.viewmat
    document = mapping_entry(str(file), read_json(file))
    where = f"{file}: ply_file_path"
    points, colors = _read_points(folder / check_inside(where, require(where, document, "ply_file_path")))
    return SfmModel(cameras[0].K, poses, points, colors)


def _read_points(file: Path) -> tuple[np.ndarray, np.ndarray | None]:
    cloud = load_mesh_file(file, "the model's points", trimesh.load)
    points = array_entry(f"{file}: points", getattr(cloud, "vertices", None), ("N", 3))
    colors = np.asarray(getattr(cloud, "colors", np.zeros((0, 4))))
    return points, colors[:, :3] / 255.0 if len(colors) == len(points) else None


def _read_colmap(folder: Path, size: tuple[int, int]) -> SfmModel:
    place = _model_folder(folder)
    if place is None:
        raise InputError(f"{folder}: expected {TRANSFORMS_FILE} or a COLMAP model in sparse/0, found neither")
    check_model_files(place)
    try:
        model = pycolmap.Reconstruction(str(place))
    except Exception as error:  # pycolmap raises its C++ exceptions
        raise InputError(f"{place}: expected a COLMAP model, found a damaged one ({error})") from None
    used = {image.camera_id for image in model.images.values()}
    if len(used) != 1:
        raise InputError(f"{place}: expected images of one camera, found {len(used)} cameras")
    camera = model.cameras[used.pop()]
    if (camera.width, camera.height) != size:
        raise InputError(
            f"{place}: expected a camera of {size[0]} x {size[1]}, found {camera.width} x {camera.height}"
        )
    if any(camera.params[i] for i in camera.extra_params_idxs()):
        raise InputError(
            f"{place}: expected a camera without distortion, found {camera.model.name} with it "
            "(colmap image_undistorter removes it)"
        )
    poses = {}
    for image in model.images.values():
        pose = image.cam_from_world
        # A property became a method between versions.
        poses[Path(image.name).stem] = np.vstack(
            [(pose() if callable(pose) else pose).matrix(), [0, 0, 0, 1]]
        )
        check_rotations(f"{place}: pose of image {shown(image.name)}", poses[Path(image.name).stem][:3, :3])
        check_finite(f"{place}: pose of image {shown(image.name)}", poses[Path(image.name).stem])
    K = array_entry(f"{place}: camera", camera.calibration_matrix(), (3, 3))
    _check_lens(f"{place}: camera", K, size)
    points = list(model.points3D.values())
    return SfmModel(
        K=K,
        poses=poses,
        points=np.array([point.xyz for point in points]).reshape(-1, 3),
        colors=np.array([point.color for point in points]).reshape(-1, 3) / 255.0,
    )


def _check_lens(where: str, K: np.ndarray, size: tuple[int, int]) -> None:
    """A pinhole that sees the image: less than 179.8 degrees, and its middle not far outside."""
    for axis, name in enumerate(("fx", "fy")):
        if K[axis, axis] < _LEAST_FOCAL * size[axis]:
            raise InputError(f"{where}: {name}: expected a positive focal length, found {K[axis, axis]:g}")
    for axis, name in enumerate(("cx", "cy")):
        if not -size[axis] <= K[axis, 2] <= 2 * size[axis]:
            raise InputError(
                f"{where}: {name}: expected a place in or near the image of {size[0]} x {size[1]}, found "
                f"{K[axis, 2]:g}"
            )


def _read_hands(file: Path, frames: int) -> tuple[dict[Side, HandTrack], float | None]:
    """The hands, and metres per unit of the model where the file tells it."""
    arrays = read_npz(file, "estimates of the hands")
    hands = {side: _read_hand(file, arrays, side, frames) for side in SIDES if f"{side}_transl" in arrays}
    if not hands:
        raise InputError(f"{file}: expected right_transl or left_transl, found {', '.join(arrays)}")
    if "object_scale" not in arrays:
        return hands, None
    return hands, positive_entry(f"{file}: object_scale", arrays["object_scale"])


def _read_hand(file: Path, arrays: Mapping[str, np.ndarray], side: Side, frames: int) -> HandTrack:
    def field(key: str, shape: tuple[int, ...], *, finite: bool = True) -> np.ndarray:
        name = f"{side}_{key}"
        return array_entry(f"{file}: {name}", require(f"{file}: {name}", arrays, name), shape, finite=finite)

    valid = np.ones(frames, dtype=bool)
    if f"{side}_valid" in arrays:
        valid = field("valid", (frames,)).astype(bool)
    rotations = np.concatenate(
        [
            field("global_orient", (frames, 3), finite=False)[:, None],
            field("hand_pose", (frames, 15, 3), finite=False),
        ],
        axis=1,
    )
    transl = field("transl", (frames, 3), finite=False)
    known = np.isfinite(rotations).all(axis=(1, 2)) & np.isfinite(transl).all(axis=1)
    if not valid.any() or (valid & ~known).any():
        found = "none" if not valid.any() else f"one that is not in frame {np.flatnonzero(valid & ~known)[0]}"
        raise InputError(f"{file}: {side}_valid: expected valid frames with finite poses, found {found}")
    rotations = fill_rotations(rotations, valid)
    return HandTrack(
        global_orient=rotations[:, 0],
        hand_pose=rotations[:, 1:],
        transl=fill_vectors(transl, valid),
        betas=field("betas", (10,)),
        valid=valid,
    )


def _object_track(
    folder: Path,
    model: SfmModel,
    stems: Sequence[str],
    hands: Mapping[Side, HandTrack],
    scale: float | None,
) -> ObjectTrack:
    valid = np.array([stem in model.poses for stem in stems])
    points = array_entry(f"{folder}: points of the model", model.points, ("N", 3))
    if not valid.any():
        raise InputError(
            f"{folder}: expected a model with the images {stems[0]} ..., found none of them in it"
        )
    if len(points) < 4:
        raise InputError(f"{folder}: expected points that span a volume, found {len(points)}")
    poses = np.stack([model.poses.get(stem, np.full((4, 4), np.nan)) for stem in stems])
    rotvecs = np.full((len(stems), 1, 3), np.nan)
    rotvecs[valid, 0] = Rotation.from_matrix(poses[valid, :3, :3]).as_rotvec()
    rotations = Rotation.from_rotvec(fill_rotations(rotvecs, valid)[:, 0]).as_matrix()
    transl = fill_vectors(poses[:, :3, 3], valid)
    if scale is None:
        middle = np.median(points, axis=0)
        depths = (rotations @ middle + transl)[:, 2]
        hand_depths = np.mean([track.transl[:, 2] for track in hands.values()], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = float(np.median((hand_depths / depths)[valid]))
        if not 0.0 < scale < np.inf:
            raise InputError(
                f"{folder}: expected hands and object in front of the camera, found one behind it"
            )
    return ObjectTrack(
        points=points,
        colors=model.colors,
        scale=scale,
        metric_from_canon=np.diag([scale, scale, scale, 1.0]),
        rotations=rotations,
        transl=scale * transl,
        valid=valid,
    )

"""HO-3D (versions 2 and 3): one right hand and a YCB object, as pickles per frame beside rgb/.

ROOT/{train,evaluation}/CLIP/{rgb/%04d.jpg, meta/%04d.pkl}. The world is the camera with OpenGL axes, metres.
Hand poses are absolute there (`flat_hand_mean=True`); here, as everywhere else, they are relative to the hand
model's mean pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.checks import InputError, check_product, check_shape
from bigs.data.base import Clip, HandTrack
from bigs.data.entries import flat_entry, mapping_entry, require
from bigs.data.formats.annotation import Annotation, ObjectTruth, annotated_clip
from bigs.data.images import IMAGE_SUFFIXES, MASK_SUFFIXES, check_pairs, list_frames, read_image
from bigs.data.meshes import check_solid, read_mesh
from bigs.data.tracks import check_turns, fill_rotations, fill_vectors
from bigs.files import open_regular
from bigs.names import check_name
from bigs.types import Side
from bigs.unpickle import restricted_load

SPLITS = ("train", "evaluation")
CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])
# Numbers in every frame of the data set.
_SIZE = (640, 480)
# Folders of the YCB models, relative to the release's folder.
_MODEL_FOLDERS = ("models", "YCB_Video_Models/models", "../models", "../YCB_Video_Models/models")
# Our addition: label masks may lie here, beside rgb/.
_MASK_FOLDER = "mask"
# Subfolders that a path may name instead of the clip.
_PARTS = ("rgb", "meta", "depth")


class Ho3dClip(NamedTuple):
    """A clip of the release."""

    folder: Path  # ROOT/SPLIT/CLIP

    @property
    def name(self) -> str:
        """As HOLD names such a clip."""
        return f"hold_{self.folder.name}_ho3d"

    @property
    def root(self) -> Path:
        """The release's folder."""
        return self.folder.parent.parent


def find_ho3d(path: str | Path) -> Ho3dClip | None:
    """The clip that a path names, or None where it is no HO-3D folder.

    Args:
        path: ROOT/SPLIT/CLIP, one of its folders, or ROOT itself where it holds a single clip.

    Raises:
        InputError: a release with several clips of which none is named.
    """
    path = Path(path)
    folder = path.parent if path.name in _PARTS else path
    if (folder / "meta").is_dir() and any((folder / "meta").glob("*.pkl")):
        return Ho3dClip(folder)
    clips = sorted(meta.parent for split in SPLITS for meta in path.glob(f"{split}/*/meta"))
    if not clips:
        return None
    if len(clips) > 1:
        examples = ", ".join(str(clip.relative_to(path)) for clip in clips[:4])
        raise InputError(f"{path}: expected one clip of HO-3D, found {len(clips)}: {examples}")
    return Ho3dClip(clips[0])


def load_ho3d(path: str | Path, hands_mean: np.ndarray) -> Clip:
    """A clip's images with its annotation as tracks (`annotated` is set), and its masks where there are any.

    Args:
        path: see `find_ho3d`.
        hands_mean: [15, 3] of the right hand's model.

    Raises:
        InputError: one sentence naming file, field, expected and found.
    """
    clip = find_ho3d(path)
    if clip is None:
        raise InputError(f"{path}: expected a clip of HO-3D with rgb/ and meta/, found none")
    image_paths = list_frames(clip.folder / "rgb", IMAGE_SUFFIXES)
    mask_paths: tuple[Path, ...] = ()
    if (clip.folder / _MASK_FOLDER).is_dir():
        mask_paths = list_frames(clip.folder / _MASK_FOLDER, MASK_SUFFIXES)
        check_pairs(image_paths, mask_paths)
    height, width = read_image(image_paths[0]).shape[:2]
    names = [file.name for file in image_paths]
    annotation = read_ho3d(clip, names, hands_mean, (width, height))
    return annotated_clip(annotation, clip.folder, image_paths, mask_paths)


def read_ho3d(
    clip: Ho3dClip, frame_names: Sequence[str], hands_mean: np.ndarray, size: tuple[int, int] = _SIZE
) -> Annotation:
    """The annotation of some frames; those that the release does not annotate are not valid.

    A clip of the evaluation split has no hand poses, then the hand is absent.

    Args:
        clip: see `find_ho3d`.
        frame_names: names of images.
        hands_mean: [15, 3] of the right hand's model.
        size: (width, height) of the images.

    Raises:
        InputError: a missing or damaged file or field, a camera that changes, or no annotated frame.
    """
    files = [clip.folder / "meta" / f"{Path(name).stem}.pkl" for name in frame_names]
    metas = [_read_meta(file) for file in files]
    valid = np.array([meta.get("objRot") is not None for meta in metas])
    if not valid.any():
        raise InputError(f"{clip.folder / 'meta'}: expected an annotated frame, found none of {len(files)}")
    K = _camera(files, metas, valid)
    hands: dict[Side, HandTrack] = {}
    if any(meta.get("handPose") is not None for meta in metas):
        hands["right"] = _read_hand(files, metas, hands_mean)
    return Annotation(
        name=check_name(f"{clip.folder}: name", clip.name),
        frame_names=tuple(frame_names),
        width=size[0],
        height=size[1],
        K=K,
        cam_from_world=np.repeat(CV_FROM_GL[None], len(files), axis=0),
        hands=hands,
        object=_read_object(clip, files, metas, valid),
    )


def _read_meta(file: Path) -> Mapping[str, Any]:
    with open_regular(file, "the annotation of a frame") as stream:
        return mapping_entry(str(file), restricted_load(stream, name=str(file)))


def _camera(files: Sequence[Path], metas: Sequence[Mapping[str, Any]], valid: np.ndarray) -> np.ndarray:
    """K [3, 3], the same in all annotated frames."""
    first = int(np.flatnonzero(valid)[0])
    K = _numbers(files[first], metas[first], "camMat", 9).reshape(3, 3)
    for t in map(int, np.flatnonzero(valid)):
        found = _numbers(files[t], metas[t], "camMat", 9).reshape(3, 3)
        if not np.allclose(found, K, atol=1e-3):
            raise InputError(
                f"{files[t]}: camMat: expected that of {files[first].name}, found {found.tolist()}"
            )
    return K


def _read_hand(
    files: Sequence[Path], metas: Sequence[Mapping[str, Any]], hands_mean: np.ndarray
) -> HandTrack:
    valid = np.array([meta.get("handPose") is not None for meta in metas])
    poses = _column(files, metas, "handPose", 48, valid).reshape(-1, 16, 3)
    poses = fill_rotations(poses, valid)
    betas = _column(files, metas, "handBeta", 10, valid)[valid]
    return HandTrack(
        global_orient=poses[:, 0],
        hand_pose=poses[:, 1:] - hands_mean,
        transl=fill_vectors(_column(files, metas, "handTrans", 3, valid), valid),
        # One person holds one object in a clip, so its frames share one shape.
        betas=np.median(betas, axis=0),
        valid=valid,
    )


def _read_object(
    clip: Ho3dClip, files: Sequence[Path], metas: Sequence[Mapping[str, Any]], valid: np.ndarray
) -> ObjectTruth | None:
    """The YCB model in every frame; None where it is not named or the models were not downloaded."""
    first = int(np.flatnonzero(valid)[0])
    name = metas[first].get("objName")
    if name is None:
        return None
    name = check_name(f"{files[first]}: objName", name)
    places = [clip.root / folder / name / "textured_simple.obj" for folder in _MODEL_FOLDERS]
    model = next((place for place in places if place.is_file()), None)
    if model is None:
        return None
    verts, faces = read_mesh(model)
    check_solid(str(model), verts, faces)
    check_product(str(model), len(files), len(verts))
    stored = _column(files, metas, "objRot", 3, valid)
    check_turns(f"{clip.folder / 'meta'}: objRot", stored, valid)
    rotvecs = fill_rotations(stored[:, None], valid)[:, 0]
    return ObjectTruth(
        verts=verts,
        faces=faces,
        rotations=Rotation.from_rotvec(rotvecs).as_matrix(),
        transl=fill_vectors(_column(files, metas, "objTrans", 3, valid), valid),
        valid=valid,
    )


def _column(
    files: Sequence[Path], metas: Sequence[Mapping[str, Any]], key: str, count: int, valid: np.ndarray
) -> np.ndarray:
    """A field of all frames, [T, count]; NaN where not valid."""
    values = np.full((len(files), count), np.nan)
    for t in map(int, np.flatnonzero(valid)):
        values[t] = _numbers(files[t], metas[t], key, count)
    return values


def _numbers(file: Path, meta: Mapping[str, Any], key: str, count: int) -> np.ndarray:
    """A field [count]; rows and columns are the same here, as some frames hold [3, 1] for [3]."""
    values = flat_entry(f"{file}: {key}", require(f"{file}: {key}", meta, key))
    check_shape(f"{file}: {key}", values, (count,))
    return values

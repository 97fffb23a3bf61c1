"""Sequences written as the data sets lay them out, from an annotation: for tests and for other programs."""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.data.formats.annotation import Annotation, ObjectTruth
from bigs.data.formats.arctic import DEFAULT_VIEW, MM_PER_M, ArcticView
from bigs.data.formats.ho3d import CV_FROM_GL, SPLITS
from bigs.files import read_json
from bigs.names import check_name


def write_arctic(
    root: str | Path,
    annotation: Annotation,
    *,
    subject: str,
    sequence: str,
    images: Iterable[np.ndarray],
    view: int = DEFAULT_VIEW,
    offset: int = 100,
) -> Path:
    """Write a sequence as ARCTIC's raw release has it; all eight views get the annotation's camera.

    Args:
        root: folder of the release; made if missing. A second subject is added to its meta/misc.json.
        annotation: both hands, an object that does not bend, and a camera that stands still. Row t belongs to
            image number `offset` + t.
        subject: such as s05.
        sequence: OBJECT_ACTION_NUMBER.
        images: T arrays [H, W, 3] uint8, written as JPEG.
        view: folder of the images, 1 to 8.
        offset: `ioi_offset`.

    Returns:
        The folder of images, which names the view.
    """
    check_name("subject", subject)
    check_name("sequence", sequence)
    target = ArcticView(Path(root), subject, sequence, view)
    folder = target.frames_in("images")
    for part in (target.raw("mano").parent, target.root / "meta", folder):
        part.mkdir(parents=True, exist_ok=True)
    frames = len(annotation)
    hands = {
        side: {
            "rot": track.global_orient,
            "pose": track.hand_pose.reshape(frames, 45),
            "trans": track.transl,
            "shape": track.betas,
            "fitting_err": np.zeros(frames),
        }
        for side, track in annotation.hands.items()
    }
    np.save(target.raw("mano"), np.array(hands, dtype=np.object_))
    if annotation.object is not None:
        _write_object(target, annotation.object)
    meta_file = target.root / "meta" / "misc.json"
    meta = dict(read_json(meta_file)) if meta_file.is_file() else {}
    meta[subject] = {
        "gender": "neutral",
        "image_size": [[annotation.width, annotation.height]] * 9,
        "intris_mat": [annotation.K.tolist()] * 8,
        "ioi_offset": offset,
        "world2cam": [annotation.cam_from_world[0].tolist()] * 8,
    }
    meta_file.write_text(json.dumps(meta))
    _write_images(folder, [f"{offset + t:05d}.jpg" for t in range(frames)], images)
    return folder


def write_ho3d(
    root: str | Path,
    annotation: Annotation,
    *,
    clip: str,
    object_name: str,
    images: Iterable[np.ndarray],
    hands_mean: np.ndarray,
    split: str = "train",
) -> Path:
    """Write a clip as HO-3D has it, with its object among the YCB models.

    Frames in which the annotation's object is not valid get none.

    Args:
        root: folder of the release; made if missing.
        annotation: a right hand and an object that does not bend, in the camera with OpenGL axes (see
            `bigs.data.moving.in_world`).
        clip: name, such as SM1.
        object_name: the model's folder, such as 006_mustard_bottle.
        images: T arrays [H, W, 3] uint8, written as JPEG.
        hands_mean: [15, 3] of the right hand's model.
        split: train, or evaluation, where only the wrist of a hand is told.

    Returns:
        The clip's folder.
    """
    if not np.allclose(annotation.cam_from_world, CV_FROM_GL):
        raise InputError(f"{annotation.name}: expected the world to be the OpenGL camera, found another")
    for field, name in (("split", split), ("clip", clip), ("object_name", object_name)):
        check_name(field, name)
    folder = Path(root) / split / clip
    truth, hand = annotation.object, annotation.hands["right"]
    if truth is None:
        raise InputError(f"{annotation.name}: expected an object, found none")
    for part in (folder / "meta", folder / "rgb", Path(root) / "models" / object_name):
        part.mkdir(parents=True, exist_ok=True)
    _write_mesh(Path(root) / "models" / object_name / "textured_simple.obj", truth.verts, truth.faces)
    stems = [f"{t:04d}" for t in range(len(annotation))]
    _write_images(folder / "rgb", [f"{stem}.jpg" for stem in stems], images)
    objects = Rotation.from_matrix(truth.rotations).as_rotvec()
    poses = np.concatenate([hand.global_orient[:, None], hand.hand_pose + hands_mean], axis=1).reshape(-1, 48)
    for t, stem in enumerate(stems):
        meta: dict[str, Any] = {
            "objName": object_name,
            "objRot": objects[t][:, None],
            "objTrans": truth.transl[t],
            "camMat": annotation.K,
        }
        if split == SPLITS[0]:
            meta |= {"handPose": poses[t], "handTrans": hand.transl[t], "handBeta": hand.betas}
        if not truth.valid[t]:
            meta = dict.fromkeys(meta)
        with (folder / "meta" / f"{stem}.pkl").open("wb") as file:
            pickle.dump(meta, file, protocol=2)
    with (Path(root) / f"{split}.txt").open("a") as listing:
        listing.writelines(f"{clip}/{stem}\n" for stem in stems)
    return folder


def write_colmap(folder: str | Path, clip: Clip) -> Path:
    """Write a clip with estimates as a COLMAP model in text form, with frames, masks and hands.npz beside.

    See `sfm_folder` for the files. The model's unit is that of the clip's structure from motion.

    Args:
        folder: where to; made if missing.
        clip: its world must be the camera, and it must have an object and masks.

    Returns:
        `folder`.
    """
    folder, (rotations, transl, points) = _sfm_frames(folder, clip)
    place = folder / "sparse" / "0"
    place.mkdir(parents=True, exist_ok=True)
    K = clip.K
    lens = " ".join(map(repr, [K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item()]))
    (place / "cameras.txt").write_text(f"1 PINHOLE {clip.width} {clip.height} {lens}\n")
    # Quaternions are w first there; the second line of an image, its points, is empty.
    quats = Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]]
    (place / "images.txt").write_text(
        "".join(
            f"{t + 1} {' '.join(map(repr, [*quats[t].tolist(), *transl[t].tolist()]))} 1 {path.name}\n\n"
            for t, path in enumerate(clip.image_paths)
        )
    )
    colors = _byte_colors(clip)
    (place / "points3D.txt").write_text(
        "".join(
            f"{i + 1} {' '.join(map(repr, point))} {' '.join(map(str, colors[i]))} 0.5\n"
            for i, point in enumerate(points.tolist())
        )
    )
    return folder


def write_nerfstudio(folder: str | Path, clip: Clip) -> Path:
    """Write a clip with estimates as nerfstudio has it; for the arguments see `write_colmap`."""
    folder, (rotations, transl, points) = _sfm_frames(folder, clip)
    viewmats = np.repeat(np.eye(4)[None], len(clip), axis=0)
    viewmats[:, :3, :3], viewmats[:, :3, 3] = rotations, transl
    document = {
        "camera_model": "OPENCV",
        "w": clip.width,
        "h": clip.height,
        "fl_x": float(clip.K[0, 0]),
        "fl_y": float(clip.K[1, 1]),
        "cx": float(clip.K[0, 2]),
        "cy": float(clip.K[1, 2]),
        "ply_file_path": "sparse_pc.ply",
        "frames": [
            {
                "file_path": f"images/{path.name}",
                "transform_matrix": (np.linalg.inv(viewmat) @ CV_FROM_GL).tolist(),
            }
            for path, viewmat in zip(clip.image_paths, viewmats, strict=True)
        ],
    }
    (folder / "transforms.json").write_text(json.dumps(document))
    trimesh.PointCloud(points, colors=_byte_colors(clip)).export(folder / "sparse_pc.ply")
    return folder


def _sfm_frames(folder: str | Path, clip: Clip) -> tuple[Path, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """What both layouts share: frames, masks and hands, and the object's poses and points in their own
    unit."""
    folder, track = Path(folder), clip.object
    if track is None or not np.allclose(clip.cam_from_world, np.eye(4)):
        raise InputError(f"{clip.folder}: expected an object in the camera's own frame, found another clip")
    for part, read in (("images", clip.image), ("masks", clip.mask)):
        (folder / part).mkdir(parents=True, exist_ok=True)
        for t, path in enumerate(clip.image_paths):
            Image.fromarray(read(t)).save(folder / part / f"{path.stem}.png")
    fields = {
        f"{side}_{key}": getattr(hand, key)
        for side, hand in clip.hands.items()
        for key in ("global_orient", "hand_pose", "transl", "betas", "valid")
    }
    np.savez(folder / "hands.npz", object_scale=track.scale, **fields)
    own = track.metric_from_canon / np.array([[track.scale]] * 3 + [[1.0]])
    points = track.points @ own[:3, :3].T + own[:3, 3]
    return folder, (track.rotations, track.transl / track.scale, points)


def _byte_colors(clip: Clip) -> np.ndarray:
    track = clip.object
    if track is None or track.colors is None:
        return np.full((0 if track is None else len(track.points), 3), 128, dtype=np.uint8)
    return (255 * track.colors).round().astype(np.uint8)


def _write_object(target: ArcticView, truth: ObjectTruth) -> None:
    """The template in millimetres with all vertices in one part, and poses that bend nothing."""
    folder = target.root / "meta" / "object_vtemplates" / target.object_name
    folder.mkdir(parents=True, exist_ok=True)
    _write_mesh(folder / "mesh.obj", MM_PER_M * truth.verts, truth.faces)
    (folder / "parts.json").write_text(json.dumps([0] * len(truth.verts)))
    poses = np.zeros((len(truth.transl), 7))
    poses[:, 1:4] = Rotation.from_matrix(truth.rotations).as_rotvec()
    poses[:, 4:] = MM_PER_M * truth.transl
    np.save(target.raw("object"), poses)


def _write_mesh(path: Path, verts: np.ndarray, faces: np.ndarray) -> None:
    if verts.ndim != 2:
        raise InputError(f"{path}: expected an object that does not bend, found vertices of every frame")
    mesh = trimesh.Trimesh(verts, faces, process=False)
    path.write_text(str(mesh.export(file_type="obj", digits=12)))


def _write_images(folder: Path, names: Sequence[str], images: Iterable[np.ndarray]) -> None:
    for name, image in zip(names, images, strict=True):
        Image.fromarray(image).save(folder / name, quality=95)

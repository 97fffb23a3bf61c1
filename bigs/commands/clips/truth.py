"""The truth of a run's frames, from whatever file or data set holds it."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bigs.checks import InputError, found_at
from bigs.data.excerpt import excerpt_trajectory
from bigs.data.formats.annotation import Annotation
from bigs.data.formats.arctic import find_arctic, read_arctic
from bigs.data.formats.ho3d import find_ho3d, read_ho3d
from bigs.data.ground_truth import load_ground_truth
from bigs.hand import HandModel
from bigs.types import HandObjectTrajectory, Side


def load_truth(
    path: Path, frame_names: Sequence[str], hand_models: Mapping[Side, HandModel]
) -> HandObjectTrajectory:
    """The true joints and meshes of a clip.

    Args:
        path: `gt.npz` or the folder that holds it, a sequence of ARCTIC's raw release, or a clip of HO-3D.
        frame_names: the frames wanted, by their own names. Where none is named, or `gt.npz` lacks one, it
            gives all that it has; `match_frames` will say what does not fit.
        hand_models: those that the data set's poses were fitted with; `gt.npz` needs none.

    Returns:
        The trajectory; NaN in frames that the data set does not annotate.

    Raises:
        InputError: no truth there, or it is invalid.
    """
    if is_own_truth(path):
        return _frames_of(load_ground_truth(path), frame_names)
    return pose_annotation(read_annotation(path, frame_names, hand_models), hand_models)


def _frames_of(truth: HandObjectTrajectory, frame_names: Sequence[str]) -> HandObjectTrajectory:
    """Of a clip's truth the frames that an excerpt of the clip has; all of it if it lacks one of them."""
    wanted = {PurePath(name).stem for name in frame_names}
    kept = [t for t, name in enumerate(truth.frame_names) if PurePath(name).stem in wanted]
    if not kept or len(kept) != len(frame_names) or len(kept) == len(truth.frame_names):
        return truth
    return excerpt_trajectory(truth, kept)


def is_own_truth(path: Path) -> bool:
    """Whether a path means `gt.npz`, which needs no hand model, rather than a data set."""
    return path.suffix == ".npz" or (path / "gt.npz").is_file()


def read_annotation(
    path: Path, frame_names: Sequence[str], hand_models: Mapping[Side, HandModel]
) -> Annotation:
    """A data set's annotation of some frames, by their own names.

    Raises:
        InputError: no data set there, or it is invalid.
    """
    clip = find_ho3d(path) if path.is_dir() else None
    if clip is not None:
        return read_ho3d(clip, frame_names, hand_models["right"].hands_mean.double().numpy())
    sequence = find_arctic(path)
    if sequence is not None:
        return read_arctic(sequence, frame_names)
    raise InputError(
        f"{path}: expected gt.npz, a folder that holds it, an ARCTIC raw sequence or an HO-3D clip, found "
        f"{'another folder' if path.is_dir() else found_at(path)}"
    )


def find_ground_truth(clip: Path) -> Path | None:
    """The gt.npz of a clip, beside its build folder; None when it has none."""
    places = (clip, clip.resolve().parent) if clip.resolve().name == "build" else (clip,)
    return next((place / "gt.npz" for place in places if (place / "gt.npz").is_file()), None)


@torch.no_grad()
def pose_annotation(annotation: Annotation, hand_models: Mapping[Side, HandModel]) -> HandObjectTrajectory:
    """An annotation as joints and meshes in the camera's frame, in double precision."""
    to_cam = annotation.cam_from_world
    joints: dict[Side, np.ndarray] = {}
    verts: dict[Side, np.ndarray] = {}
    for side, track in annotation.hands.items():
        model = copy.deepcopy(hand_models[side]).double()
        betas = torch.from_numpy(track.betas)
        wrist = model.rest_joints(betas)[0].numpy() + track.transl
        orient = to_cam[:, :3, :3] @ Rotation.from_rotvec(track.global_orient).as_matrix()
        wrist_cam = np.einsum("tij,tj->ti", to_cam[:, :3, :3], wrist) + to_cam[:, :3, 3]
        fingers = model.pose_matrices(torch.from_numpy(track.hand_pose))
        out = model(betas, fingers, torch.from_numpy(orient), torch.from_numpy(wrist_cam))
        unknown = ~track.valid[:, None, None]
        joints[side] = np.where(unknown, np.nan, out.joints.numpy())
        verts[side] = np.where(unknown, np.nan, out.vertices.numpy())
    object_verts = None
    if annotation.object is not None:
        world = annotation.object.verts_world()
        object_verts = np.einsum("tij,tnj->tni", to_cam[:, :3, :3], world) + to_cam[:, None, :3, 3]
        object_verts[~annotation.object.valid] = np.nan
    return HandObjectTrajectory(
        name=annotation.name,
        frame_names=annotation.frame_names,
        joints=joints,
        verts=verts,
        faces={side: hand_models[side].faces.numpy() for side in joints},
        object_verts=object_verts,
        object_faces=None if annotation.object is None else annotation.object.faces,
    )

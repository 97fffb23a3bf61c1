"""Hand tracks from what other estimators leave: the true camera, one shape, gaps filled, faults dropped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bigs.checks import InputError
from bigs.data.base import HandTrack
from bigs.data.tracks import fill_rotations, fill_vectors
from bigs.geometry.arrays import float32
from bigs.geometry.rotations import matrix_to_axis_angle
from bigs.hand import HandModel, mirror_axis_angle, mirror_points, mirror_rotation, shared_betas
from bigs.preprocess.frames.frame_ranges import frame_ranges
from bigs.preprocess.hands.dumps import Dump, GeometryDump, ParameterDump
from bigs.preprocess.hands.keypoints import Keypoints
from bigs.preprocess.hands.mesh_fit import fit_geometry
from bigs.preprocess.hands.sides import sort_sides
from bigs.preprocess.hands.skeleton import HandSkeleton
from bigs.preprocess.hands.tracks import HandEstimates, joints_of_track
from bigs.types import Side


def import_hands(
    dumps: Mapping[Side, Dump],
    K: np.ndarray,
    hand_models: Mapping[Side, HandModel],
    masks: Sequence[np.ndarray] | None = None,
) -> HandEstimates:
    """Tracks in the true camera's frame.

    Frames in which a hand sits where the other one is (by its own neighbours and, if given, by the masks)
    were predicted with the wrong side: their poses are useless, so they count as missing.

    Args:
        dumps: of one or two hands.
        K: [3, 3] true intrinsics.
        hand_models: both sides' models.
        masks: T label images.
    """
    tracks: dict[Side, HandTrack] = {}
    for side, dump in dumps.items():
        if isinstance(dump, GeometryDump):
            track = _from_geometry(side, dump, hand_models)
        else:
            track = _from_parameters(side, dump, hand_models)
        tracks[side] = _under_camera(track, hand_models[side], dump.K, K)
    keypoints = {side: _keypoints(track, hand_models[side], K) for side, track in tracks.items()}
    found = sort_sides(keypoints, masks)
    notes = []
    kept: dict[Side, HandTrack] = {}
    for side, track in tracks.items():
        wrong = (found.swapped | found.doubled[side]) & track.valid
        valid = track.valid & ~wrong
        if wrong.any():
            notes.append(f"{side} hand: on the other hand's place in {frame_ranges(wrong)}, dropped")
        if not valid.any():
            notes.append(f"{side} hand: left out, no frame is left")
            continue
        if not valid.all():
            notes.append(f"{side} hand: no estimate in {frame_ranges(~valid)}, filled from the frames around")
        kept[side] = _filled(track, valid)
    if not kept:
        raise InputError("hands: expected a frame in which a hand lies on its own mask, found none")
    return HandEstimates(kept, tuple(notes))


def _from_parameters(side: Side, dump: ParameterDump, hand_models: Mapping[Side, HandModel]) -> HandTrack:
    model = hand_models[side]
    turns = Rotation.from_matrix(dump.rotations.reshape(-1, 3, 3)).as_rotvec().reshape(-1, 16, 3)
    betas = np.median(dump.betas[dump.valid], axis=0)
    # Each frame had its own shape; the wrist stays where that put it.
    own = torch.as_tensor(dump.betas, dtype=torch.float32)
    with torch.no_grad():
        shared = model.rest_joints(torch.as_tensor(betas, dtype=torch.float32))[0]
        offset = (model.rest_joints(own)[:, 0] - shared).double().numpy()
    return HandTrack(
        global_orient=turns[:, 0],
        hand_pose=turns[:, 1:] - model.hands_mean.double().numpy(),
        transl=dump.transl + offset,
        betas=betas,
        valid=dump.valid,
    )


def _from_geometry(side: Side, dump: GeometryDump, hand_models: Mapping[Side, HandModel]) -> HandTrack:
    model, right = hand_models[side], hand_models["right"]
    joints = float32(dump.joints[dump.valid])
    vertices = None if dump.vertices is None else float32(dump.vertices[dump.valid])
    if side == "left":
        joints = mirror_points(joints)
        vertices = None if vertices is None else mirror_points(vertices)
    poses, betas, _ = fit_geometry(right, joints, vertices)
    orient, fingers, wrist = poses.orient, HandSkeleton(right).fingers(poses.angles), poses.wrist
    if side == "left":
        orient, fingers, wrist = mirror_rotation(orient), mirror_axis_angle(fingers), mirror_points(wrist)
        betas = shared_betas(model, right, betas)
    frames = len(dump.valid)
    track = HandTrack(
        np.zeros((frames, 3)),
        np.zeros((frames, 15, 3)),
        np.zeros((frames, 3)),
        betas.double().numpy(),
        dump.valid,
    )
    track.global_orient[dump.valid] = matrix_to_axis_angle(orient).double().numpy()
    track.hand_pose[dump.valid] = (fingers - model.hands_mean).double().numpy()
    track.transl[dump.valid] = (wrist - model.rest_joints(betas)[0]).double().numpy()
    return track


def _under_camera(track: HandTrack, model: HandModel, assumed: np.ndarray, K: np.ndarray) -> HandTrack:
    """The hand along the ray of its wrist at the depth at which the true camera sees it as large."""
    with torch.no_grad():
        rest = model.rest_joints(torch.as_tensor(track.betas, dtype=torch.float32))[0].double().numpy()
    wrist = track.transl + rest
    pixels = wrist @ assumed.T
    pixels = pixels[:, :2] / np.where(np.abs(pixels[:, 2:]) > 1e-6, pixels[:, 2:], 1.0)
    depth = wrist[:, 2] * (K[0, 0] + K[1, 1]) / (assumed[0, 0] + assumed[1, 1])
    rays = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
    moved = np.column_stack([rays * depth[:, None], depth])
    return HandTrack(track.global_orient, track.hand_pose, moved - rest, track.betas, track.valid)


def _keypoints(track: HandTrack, model: HandModel, K: np.ndarray) -> Keypoints:
    joints = joints_of_track(track, model)
    pixels = joints @ K.T
    points = pixels[..., :2] / np.maximum(pixels[..., 2:], 1e-3)
    return Keypoints(points, np.repeat(track.valid[:, None].astype(np.float64), joints.shape[1], axis=1))


def _filled(track: HandTrack, valid: np.ndarray) -> HandTrack:
    turns = np.concatenate([track.global_orient[:, None], track.hand_pose], axis=1)
    turns = fill_rotations(turns, valid)
    return HandTrack(turns[:, 0], turns[:, 1:], fill_vectors(track.transl, valid), track.betas, valid)

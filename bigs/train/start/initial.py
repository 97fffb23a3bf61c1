"""The clip's estimates carried into camera space and smoothed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bigs.data.base import Clip, HandTrack
from bigs.data.touching import masks_touch
from bigs.geometry.arrays import float32
from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.geometry.smoothing import interpolated_frames, smooth_rotations, smooth_vectors
from bigs.geometry.surface import inlier_points
from bigs.hand import HandModel, mirror_rotation
from bigs.threads import side_by_side
from bigs.train.plan.start_config import InitialConfig
from bigs.types import HandObjectTrajectory, Side


class HandStart(NamedTuple):
    """One hand in camera space, as poses of the canonical right hand."""

    global_orient: Tensor  # [T, 3, 3]
    hand_pose: Tensor  # [T, 15, 3, 3]
    wrist: Tensor  # [T, 3] metres, true camera space for either side
    trust: Tensor  # [T]


class ObjectStart(NamedTuple):
    """The object in camera space: x_cam = R p + centre for metric points p about their box's centre."""

    points: np.ndarray  # [N, 3] metres
    colors: np.ndarray | None
    rotations: Tensor  # [T, 3, 3]
    centers: Tensor  # [T, 3]
    trust: Tensor  # [T]


def hand_in_camera(
    track: HandTrack, cam_from_world: np.ndarray, model: HandModel, config: InitialConfig
) -> HandStart:
    """Carry a hand's estimates into camera space; nothing is smoothed yet.

    `model` is that side's own model: its rest wrist and mean pose are part of the track's convention.
    """
    to_cam = torch.as_tensor(cam_from_world, dtype=torch.float32)
    orient = to_cam[:, :3, :3] @ axis_angle_to_matrix(float32(track.global_orient))
    pose = model.pose_matrices(float32(track.hand_pose))
    wrist_world = model.rest_joints(float32(track.betas))[0] + float32(track.transl)
    wrist = (to_cam[:, :3, :3] @ wrist_world[..., None])[..., 0] + to_cam[:, :3, 3]
    if model.side == "left":
        orient, pose = mirror_rotation(orient), mirror_rotation(pose)
    return HandStart(orient, pose, wrist, _trust(track.valid, float32(track.transl), config))


def object_in_camera(clip: Clip, config: InitialConfig) -> ObjectStart:
    """Carry the object's estimates into camera space, its points metric about their box's centre."""
    track = clip.object
    metric = track.points @ track.metric_from_canon[:3, :3].T + track.metric_from_canon[:3, 3]
    keep = inlier_points(metric)
    middle = 0.5 * (metric[keep].min(0) + metric[keep].max(0))
    to_cam = clip.cam_from_world
    rotations = to_cam[:, :3, :3] @ track.rotations
    centers_world = track.rotations @ middle + track.transl
    centers = np.einsum("tij,tj->ti", to_cam[:, :3, :3], centers_world) + to_cam[:, :3, 3]
    return ObjectStart(
        metric[keep] - middle,
        None if track.colors is None else track.colors[keep],
        torch.as_tensor(rotations, dtype=torch.float32),
        torch.as_tensor(centers, dtype=torch.float32),
        _trust(track.valid, torch.as_tensor(track.transl), config),
    )


def _trust(valid: np.ndarray, transl: Tensor, config: InitialConfig) -> Tensor:
    doubtful = interpolated_frames(transl) | ~torch.as_tensor(valid)
    return torch.where(doubtful, config.interpolated_trust, 1.0)


def smooth_hand(start: HandStart, sigma: float) -> HandStart:
    """Robustly smoothed rotations and position; ray and log depth apart, since their noises differ."""
    rotations = torch.cat([start.global_orient[:, None], start.hand_pose], dim=1).transpose(0, 1)
    global_orient, *hand_pose = smooth_rotations(rotations, start.trust, sigma)
    return HandStart(
        global_orient,
        torch.stack(hand_pose, dim=1),
        _smooth_positions(start.wrist, start.trust, sigma),
        start.trust,
    )


def smooth_object(start: ObjectStart, sigma: float) -> ObjectStart:
    """Robustly smoothed rotations and positions of the object."""
    return start._replace(
        rotations=smooth_rotations(start.rotations, start.trust, sigma),
        centers=_smooth_positions(start.centers, start.trust, sigma),
    )


def _smooth_positions(positions: Tensor, trust: Tensor, sigma: float) -> Tensor:
    depth = positions[:, 2:].log()
    rays = smooth_vectors(positions[:, :2] / positions[:, 2:], trust, sigma)
    depth = smooth_vectors(depth, trust, sigma).exp()
    return torch.cat([rays * depth, depth], dim=1)


@torch.no_grad()
def initial_trajectory(clip: Clip, hand_models: Mapping[Side, HandModel]) -> HandObjectTrajectory:
    """The clip's estimates, posed in camera space: the baseline of a reconstruction.

    The object is the bare point set of the file.
    """
    config = InitialConfig()
    joints, verts, faces = {}, {}, {}
    for side, track in clip.hands.items():
        model = hand_models[side]
        start = hand_in_camera(track, clip.cam_from_world, model, config)
        orient, pose = start.global_orient, start.hand_pose
        if side == "left":
            orient, pose = mirror_rotation(orient), mirror_rotation(pose)
        out = model(torch.as_tensor(track.betas, dtype=torch.float32), pose, orient, start.wrist)
        joints[side], verts[side] = out.joints.numpy(), out.vertices.numpy()
        faces[side] = model.faces.numpy()
    points = None
    if clip.object is not None:
        to_cam = clip.cam_from_world
        points = (
            np.einsum("tij,tnj->tni", to_cam[:, :3, :3], clip.object.points_world()) + to_cam[:, None, :3, 3]
        )
    return HandObjectTrajectory(clip.name, clip.frame_names, joints, verts, faces, points, None)


def touching_frames(clip: Clip, side: Side, reach: int = 3) -> np.ndarray:
    """Frames [T] (bool) in which the masks of a hand and of the object come within `reach` pixels."""
    shown = (clip.mask_areas[side] > 0) & (clip.mask_areas["object"] > 0)
    touch = np.zeros(len(clip), dtype=bool)
    frames = np.flatnonzero(shown)
    touch[frames] = side_by_side(lambda t: masks_touch(clip.mask(t), side, reach), frames)
    return touch

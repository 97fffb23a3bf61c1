"""Hand tracks from keypoints: sides sorted, both hands fitted together, gaps filled and marked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import torch

from bigs.checks import InputError
from bigs.data.base import HandTrack
from bigs.data.tracks import fill_rotations, fill_vectors
from bigs.geometry.arrays import float32
from bigs.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from bigs.hand import HandModel, mirror_axis_angle, mirror_points, mirror_rotation, shared_betas
from bigs.hand.model import HandOutput
from bigs.preprocess.frames.frame_ranges import frame_ranges
from bigs.preprocess.hands.fit import HandFitConfig, fit_rays
from bigs.preprocess.hands.keypoints import Keypoints
from bigs.preprocess.hands.sides import drop_strays, sort_sides
from bigs.preprocess.hands.skeleton import HandPoses, HandSkeleton
from bigs.types import Side


@dataclass(frozen=True)
class HandEstimates:
    """Tracks in the camera frame, and what was noticed on the way, a sentence each."""

    tracks: dict[Side, HandTrack]
    notes: tuple[str, ...]


def fit_hands(
    keypoints: Mapping[Side, Keypoints],
    K: np.ndarray,
    hand_models: Mapping[Side, HandModel],
    *,
    fps: float = 30.0,
    masks: Sequence[np.ndarray] | None = None,
    config: HandFitConfig | None = None,
) -> HandEstimates:
    """Fit the hand model to keypoints.

    Args:
        keypoints: of one or two hands, pixels.
        K: [3, 3] true intrinsics.
        hand_models: both sides' models; both hands get the shape of one person.
        fps: frames a second.
        masks: T label images, which tell swapped sides and stray keypoints.
        config: how to fit.

    Raises:
        InputError: no hand has a frame with enough keypoints.
    """
    config = config or HandFitConfig()
    keypoints, notes = _clean(keypoints, masks)
    sides: list[Side] = []
    for side, hand in keypoints.items():
        most = int((hand.confidence > 0).sum(1).max())
        if most >= config.joints_needed:
            sides.append(side)
        else:
            notes.append(
                f"{side} hand: left out, no frame shows {config.joints_needed} joints (most: {most})"
            )
    if not sides:
        raise InputError(
            f"keypoints: expected a frame with at least {config.joints_needed} joints of a hand, found none"
        )
    skeleton = HandSkeleton(hand_models["right"])
    rays = np.stack([(keypoints[side].points - K[:2, 2]) / K[[0, 1], [0, 1]] for side in sides])
    for i, side in enumerate(sides):
        if side == "left":
            rays[i, ..., 0] *= -1.0
    trust = np.stack([keypoints[side].confidence for side in sides])
    fit = fit_rays(skeleton, float32(rays), float32(trust), config, fps)
    tracks: dict[Side, HandTrack] = {}
    for i, side in enumerate(sides):
        valid = (fit.explained[i] >= config.joints_needed).numpy()
        if not valid.any():
            notes.append(f"{side} hand: left out, no pose explains its keypoints in any frame")
            continue
        poses = HandPoses(*(part[i] for part in fit.poses))
        tracks[side] = _track(side, poses, fit.betas, valid, skeleton, hand_models)
        if not valid.all():
            notes.append(f"{side} hand: no estimate in {frame_ranges(~valid)}, filled from the frames around")
    if not tracks:
        raise InputError("keypoints: expected points that the pose of a hand explains, found none")
    return HandEstimates(tracks, tuple(notes))


@torch.no_grad()
def posed_track(track: HandTrack, model: HandModel) -> HandOutput:
    """A track's vertices and joints in its own space, metres."""
    orient, pose, betas, transl = (
        torch.as_tensor(array, dtype=torch.float32)
        for array in (track.global_orient, track.hand_pose, track.betas, track.transl)
    )
    wrist = model.rest_joints(betas)[0] + transl
    return model(betas, model.pose_matrices(pose), axis_angle_to_matrix(orient), wrist)


def joints_of_track(track: HandTrack, model: HandModel) -> np.ndarray:
    """The 21 joints [T, 21, 3] of a track in its own space, metres."""
    return posed_track(track, model).joints.double().numpy()


def _clean(
    keypoints: Mapping[Side, Keypoints], masks: Sequence[np.ndarray] | None
) -> tuple[dict[Side, Keypoints], list[str]]:
    """Keypoints on their own sides without strays."""
    found = sort_sides(keypoints, masks)
    notes = []
    if found.swapped.any():
        notes.append(f"hands: sides swapped back in {frame_ranges(found.swapped)}")
    for side, frames in found.doubled.items():
        if frames.any():
            notes.append(f"{side} hand: the other hand found twice in {frame_ranges(frames)}, dropped")
    if masks is None:
        return found.hands, notes
    away = [
        scipy.ndimage.distance_transform_edt(mask == 0) if mask.any() else np.zeros(mask.shape)
        for mask in masks
    ]
    return drop_strays(found.hands, away), notes


def _track(
    side: Side,
    poses: HandPoses,
    betas: torch.Tensor,
    valid: np.ndarray,
    skeleton: HandSkeleton,
    hand_models: Mapping[Side, HandModel],
) -> HandTrack:
    """A fit as a track in that side's own convention, invalid frames filled."""
    model = hand_models[side]
    orient, fingers, wrist = poses.orient, skeleton.fingers(poses.angles), poses.wrist
    if side == "left":
        orient, fingers, wrist = mirror_rotation(orient), mirror_axis_angle(fingers), mirror_points(wrist)
        betas = shared_betas(model, hand_models["right"], betas)
    transl = wrist - model.rest_joints(betas)[0]
    turns = torch.cat([matrix_to_axis_angle(orient)[:, None], fingers], dim=1).double().numpy()
    turns = fill_rotations(turns, valid)
    return HandTrack(
        global_orient=turns[:, 0],
        hand_pose=turns[:, 1:] - model.hands_mean.double().numpy(),
        transl=fill_vectors(transl.double().numpy(), valid),
        betas=betas.double().numpy(),
        valid=valid,
    )

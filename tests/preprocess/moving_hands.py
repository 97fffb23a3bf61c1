"""Hands that move before a camera, and what a keypoint detector would say of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bigs.data.base import HandTrack
from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.hand import HandModel
from bigs.preprocess.hands.keypoints import Keypoints
from bigs.types import Side

K = np.array([[900.0, 0.0, 250.0], [0.0, 910.0, 170.0], [0.0, 0.0, 1.0]])


def pose_track(model: HandModel, track: HandTrack) -> np.ndarray:
    """The 21 joints [T, 21, 3] of a track in the camera frame."""
    orient, pose, betas, transl = (
        torch.as_tensor(a, dtype=torch.float32)
        for a in (track.global_orient, track.hand_pose, track.betas, track.transl)
    )
    with torch.no_grad():
        wrist = model.rest_joints(betas)[0] + transl
        out = model(betas, model.pose_matrices(pose), axis_angle_to_matrix(orient), wrist)
    return out.joints.numpy()


def moving_hand(side: Side, model: HandModel, frames: int, seed: int) -> HandTrack:
    """A hand that turns and closes; right and left hands of one seed have one shape and different motions."""
    rng = np.random.default_rng(seed + (100 if side == "left" else 0))
    time = np.linspace(0.0, frames / 30.0, frames)
    first = Rotation.random(random_state=rng)
    turn = Rotation.from_rotvec(time[:, None] * rng.normal(0.0, 1.0, 3))
    bend = 0.35 + 0.25 * np.sin(2.0 * time[:, None] + rng.uniform(0, 6, 5))
    # Fingers of a MANO right hand point along -x with the palm down: they close about +z.
    axis = np.array([0.0, 0.0, 1.0 if side == "right" else -1.0])
    angles = np.repeat(bend, 3, axis=1)
    angles[:, 12:] *= 0.3
    place = np.array([0.09 if side == "right" else -0.09, 0.0, 0.7])
    return HandTrack(
        global_orient=(turn * first).as_rotvec(),
        hand_pose=angles[..., None] * axis - model.hands_mean.numpy(),
        transl=place + 0.02 * np.sin(time[:, None] + rng.uniform(0, 6, 3)),
        betas=np.clip(0.5 * np.random.default_rng(seed).normal(size=10), -1, 1),
        valid=np.ones(frames, dtype=bool),
    )


def detect(joints: np.ndarray, rng: np.random.Generator, noise: float = 2.0) -> Keypoints:
    """Keypoints with noise, some missing and some far off."""
    pixels = joints @ K.T
    points = pixels[..., :2] / pixels[..., 2:] + noise * rng.standard_normal((*joints.shape[:2], 2))
    confidence = np.where(rng.random(joints.shape[:2]) < 0.05, 0.0, rng.uniform(0.6, 1.0, joints.shape[:2]))
    points += np.where(rng.random(joints.shape[:2]) < 0.03, 40.0, 0.0)[..., None]
    return Keypoints(np.where(confidence[..., None] > 0, points, 0.0), confidence)


def two_hands(models: Mapping[Side, HandModel], frames: int, seed: int) -> dict[Side, HandTrack]:
    return {side: moving_hand(side, models[side], frames, seed) for side in ("right", "left")}

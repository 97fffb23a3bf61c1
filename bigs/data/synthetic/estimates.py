"""Initial estimates with the errors that hand regressors and structure from motion make.

Truth in, guesses out, all in the OpenCV camera frame. Hands err by 20 to 27 mm root-aligned and by 3 to 6 cm
in depth, the object by 1 to 2 degrees, its scale by 5 to 10 percent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.data.synthetic.grasp import FINGERS, HandLike, bend_axes, pose_hand, rest_joints
from bigs.data.synthetic.motion import HandMotion, smooth_noise
from bigs.data.tracks import fill_rotations, fill_vectors

# Radians before scaling: constant over the clip, slow, and per frame.
_FINGER_ERROR = (0.16, 0.15, 0.05)
_WRIST_ERROR = (0.10, 0.09, 0.03)
_SIDEWAYS_BEND = 0.35  # errors across the flexion axis, relative to those along it
_GROSS_ERROR = 0.6  # radians, in the few grossly wrong frames
_JOINT_ERROR = (0.0205, 0.0265)  # metres, mean over frames and joints, root-aligned
_DEPTH_ERROR = (0.032, 0.055)  # metres, root mean square
_SIDE_ERROR = (0.011, 0.018)
_JITTER = 0.005
_OBJECT_JITTER = 0.004
_OUTLIERS = 0.04


@dataclass(frozen=True)
class HandGuess:
    """A hand as a regressor would give it, camera frame."""

    betas: np.ndarray  # [10]
    fingers: np.ndarray  # [T, 15, 3] axis-angle, no mean pose removed
    rotations: np.ndarray  # [T, 3, 3]
    wrists: np.ndarray  # [T, 3]
    dropped: np.ndarray  # [T] bool: no detection, interpolated


@dataclass(frozen=True)
class ObjectGuess:
    """The object as structure from motion would give it: x_cam = rotations (scale X) + transl."""

    points: np.ndarray  # [N, 3] X, in its own frame and unit
    outliers: np.ndarray  # [N] bool
    scale: float  # metres per unit, estimated
    rotations: np.ndarray  # [T, 3, 3]
    transl: np.ndarray  # [T, 3]
    dropped: np.ndarray  # [T] bool
    scale_error: float  # relative
    similarity: tuple[float, np.ndarray, np.ndarray]  # (s, R, t): true x_object = s R X + t


def guess_hand(rng: np.random.Generator, model: HandLike, truth: HandMotion, seen: np.ndarray) -> HandGuess:
    """Disturb a true hand.

    Args:
        rng: random numbers.
        model: the hand.
        truth: its motion.
        seen: [5] in [0, 1], how much of each finger (in the order of `FINGERS`) the camera sees.
    """
    frames = len(truth.wrists)
    finger_error = _finger_errors(rng, rest_joints(model, truth.betas), seen, frames)
    wrist_error = _three_parts(rng, frames, 3, _WRIST_ERROR)
    gross = rng.choice(frames, size=max(1, round(frames / 30)), replace=False)
    wrist_error[gross] += _GROSS_ERROR * _directions(rng, len(gross))
    betas = truth.betas + rng.choice([-1, 1], 10) * rng.uniform(0.35, 0.65, 10)
    betas[0] = truth.betas[0] + 0.9 * rng.choice([-1, 1])
    dropped = _drop(rng, frames, max(1, round(frames * rng.uniform(0.05, 0.13))))
    wrists = _displace(rng, truth.wrists)

    target = rng.uniform(*_JOINT_ERROR)
    share = 1.0
    # The error grows almost in proportion to the share, so a few corrections reach the target.
    for _ in range(6):
        fingers = _compose(truth.fingers, share * finger_error)
        rotations = truth.rotations @ Rotation.from_rotvec(share * wrist_error).as_matrix()
        fingers = fill_rotations(fingers, ~dropped)
        rotvecs = Rotation.from_matrix(rotations).as_rotvec()[:, None]
        rotations = Rotation.from_rotvec(fill_rotations(rotvecs, ~dropped)[:, 0]).as_matrix()
        _, joints = pose_hand(model, betas, fingers, rotations, wrists)
        share *= target / root_aligned_error(joints, truth.joints)
    return HandGuess(betas, fingers, rotations, fill_vectors(wrists, ~dropped), dropped)


def root_aligned_error(joints: np.ndarray, truth: np.ndarray) -> float:
    """Mean distance of joints [T, 21, 3] after the wrists are brought together, metres."""
    apart = (joints - joints[:, :1]) - (truth - truth[:, :1])
    return float(np.linalg.norm(apart, axis=-1).mean())


def guess_object(
    rng: np.random.Generator,
    points: np.ndarray,
    normals: np.ndarray,
    rotations: np.ndarray,
    transl: np.ndarray,
) -> ObjectGuess:
    """Disturb a true object.

    Args:
        rng: random numbers.
        points: [N, 3] points seen on the true surface, object frame, metres.
        normals: [N, 3] of the surface there.
        rotations, transl: the true pose in the camera, [T, 3, 3] and [T, 3].
    """
    frames = len(rotations)
    noisy = points + 0.0007 * rng.standard_normal(points.shape)
    noisy += 0.0009 * rng.standard_normal((len(points), 1)) * normals
    outliers = rng.random(len(points)) < _OUTLIERS
    noisy[outliers] += rng.uniform(0.006, 0.035, (outliers.sum(), 1)) * _directions(rng, int(outliers.sum()))

    s, R, t = (
        rng.uniform(0.05, 0.15),
        Rotation.random(random_state=rng).as_matrix(),
        rng.uniform(-0.03, 0.03, 3),
    )
    scale_error = rng.uniform(0.05, 0.10) * rng.choice([-1, 1])
    dropped = _drop(rng, frames, max(1, round(frames * rng.uniform(0.02, 0.06))))
    turn = np.deg2rad(rng.uniform(1.0, 1.6)) / np.sqrt(3) * smooth_noise(rng, frames, 3, sigma=1.0)
    guessed_rotations = rotations @ R @ Rotation.from_rotvec(turn).as_matrix()
    # Scale and depth are wrong by the same factor, so the picture stays right.
    centers = (np.einsum("tij,j->ti", rotations, t) + transl) * (1 + scale_error)
    centers += _OBJECT_JITTER / np.sqrt(3) * rng.standard_normal((frames, 3))
    rotvecs = Rotation.from_matrix(guessed_rotations).as_rotvec()[:, None]
    return ObjectGuess(
        points=(noisy - t) @ R / s,
        outliers=outliers,
        scale=s * (1 + scale_error),
        rotations=Rotation.from_rotvec(fill_rotations(rotvecs, ~dropped)[:, 0]).as_matrix(),
        transl=fill_vectors(centers, ~dropped),
        dropped=dropped,
        scale_error=float(scale_error),
        similarity=(float(s), R, t),
    )


def _three_parts(
    rng: np.random.Generator, frames: int, dims: int, parts: tuple[float, float, float]
) -> np.ndarray:
    """Errors [frames, dims] that are constant, slow and sudden."""
    constant, slow, sudden = parts
    return (
        constant * rng.standard_normal(dims)
        + slow * smooth_noise(rng, frames, dims)
        + sudden * rng.standard_normal((frames, dims))
    )


def _finger_errors(rng: np.random.Generator, joints: np.ndarray, seen: np.ndarray, frames: int) -> np.ndarray:
    """Rotation errors [T, 15, 3] of finger joints: mostly in how far they bend, larger where hidden."""
    axes = bend_axes(joints)
    along = _three_parts(rng, frames, 15, _FINGER_ERROR)[..., None] * axes
    across = _SIDEWAYS_BEND * _three_parts(rng, frames, 45, _FINGER_ERROR).reshape(frames, 15, 3)
    across -= (across * axes).sum(-1, keepdims=True) * axes
    error = along + across
    for share, finger in zip(seen, FINGERS.values(), strict=True):
        error[:, np.array(finger) - 1] *= 1.6 - 0.8 * share
    return error


def _compose(rotvecs: np.ndarray, errors: np.ndarray) -> np.ndarray:
    product = Rotation.from_rotvec(rotvecs.reshape(-1, 3)) * Rotation.from_rotvec(errors.reshape(-1, 3))
    return product.as_rotvec().reshape(rotvecs.shape)


def _displace(rng: np.random.Generator, wrists: np.ndarray) -> np.ndarray:
    """Wrong depth along each wrist's own ray, so that the image stays about right, and a little sideways."""
    frames = len(wrists)
    depth = 0.8 * rng.choice([-1, 1]) + 0.6 * smooth_noise(rng, frames, 1)
    depth = rng.uniform(*_DEPTH_ERROR) * depth / np.sqrt((depth**2).mean())
    depth = depth + _JITTER * rng.standard_normal((frames, 1))
    side = rng.standard_normal(2) + smooth_noise(rng, frames, 2)
    side *= rng.uniform(*_SIDE_ERROR) / np.sqrt((side**2).sum(axis=1).mean())
    moved = wrists * (1 + depth / wrists[:, 2:])
    moved[:, :2] += side + 0.3 * _JITTER * rng.standard_normal((frames, 2))
    return moved


def _drop(rng: np.random.Generator, frames: int, count: int) -> np.ndarray:
    """Which frames [T] have no estimate: `count` of them, never the first or the last."""
    dropped = np.zeros(frames, dtype=bool)
    if frames > 2:
        dropped[rng.choice(np.arange(1, frames - 1), size=min(count, frames - 2), replace=False)] = True
    return dropped


def _directions(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

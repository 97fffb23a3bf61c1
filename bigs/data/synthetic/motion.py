"""How the object, the hands and the camera move: smooth, seen from half a metre, always in the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from bigs.data.synthetic.grasp import FINGERS, Grasp, HandLike, bend_axes, pose_hand, rest_joints

# Camera axes: y points down, so up is its negative.
_UP = np.array([0.0, -1.0, 0.0])
# The rotation must show the object from all around, or structure from motion has no back side.
_TURN_DEGREES = (195.0, 250.0)
_DISTANCE = (0.52, 0.66)
# Share of the half image that bodies may fill.
_FILL = 0.92
# How far a finger lifts now and then, radians; holding hands are never quite still.
_LIFT = 0.05


@dataclass(frozen=True)
class HandMotion:
    """One true hand over the clip, camera frame, metres."""

    betas: np.ndarray  # [10]
    fingers: np.ndarray  # [T, 15, 3] axis-angle, no mean pose removed
    rotations: np.ndarray  # [T, 3, 3]
    wrists: np.ndarray  # [T, 3]
    verts: np.ndarray  # [T, V, 3]
    joints: np.ndarray  # [T, 21, 3]


def smooth_noise(rng: np.random.Generator, frames: int, dims: int, sigma: float = 3.0) -> np.ndarray:
    """Random numbers [frames, dims] of unit deviation, correlated over about 2 sigma frames."""
    pad = int(4 * sigma)
    white = rng.standard_normal((frames + 2 * pad, dims))
    smooth = gaussian_filter1d(white, sigma, axis=0)[pad : pad + frames]
    return smooth * np.sqrt(2 * np.sqrt(np.pi) * sigma)


def turn_object(rng: np.random.Generator, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [T, 3, 3] and positions [T, 3] of the object in the camera frame: one slow turn."""
    steps = 8
    time = np.linspace(0, 1, (frames - 1) * steps + 1)
    tilt = Rotation.from_euler("XYZ", [np.pi / 2 + rng.uniform(-0.1, 0.3), 0, rng.uniform(-0.25, 0.25)])
    upright = tilt * Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
    phase, sway = rng.uniform(0, 2 * np.pi, 2), rng.uniform(0.2, 0.4, 2)
    axis = np.stack(
        [sway[0] * np.sin(4 * time + phase[0]), np.zeros_like(time), sway[1] * np.sin(3 * time + phase[1])],
        axis=1,
    )
    axis = axis + _UP
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    speed = 1 + 0.35 * np.sin(2 * np.pi * time + rng.uniform(0, 2 * np.pi))
    turn = np.deg2rad(rng.uniform(*_TURN_DEGREES)) * rng.choice([-1, 1])
    velocity = axis * (turn * speed / speed[1:].sum())[:, None]
    rotation, rotations = upright, [upright.as_matrix()]
    for step in range(1, len(time)):
        rotation = Rotation.from_rotvec(velocity[step]) * rotation
        if step % steps == 0:
            rotations.append(rotation.as_matrix())
    drift = smooth_noise(rng, frames, 3, sigma=8.0) * np.array([0.008, 0.008, 0.012])
    return np.stack(rotations), drift + np.array([0, 0, rng.uniform(*_DISTANCE)])


def carry_hand(
    rng: np.random.Generator,
    model: HandLike,
    betas: np.ndarray,
    grasp: Grasp,
    rotations: np.ndarray,
    positions: np.ndarray,
) -> HandMotion:
    """Move a grasp rigidly with the object; fingers but the thumb lift a little and come back."""
    frames = len(rotations)
    axes = bend_axes(rest_joints(model, betas))
    fingers = np.repeat(grasp.fingers[None], frames, axis=0)
    for name, numbers in FINGERS.items():
        if name == "thumb":
            continue
        lift = _LIFT * np.clip(smooth_noise(rng, frames, 1)[:, 0], 0, 1)
        rows = np.array(numbers) - 1
        # Opening only: a finger never goes deeper than where it touched.
        fingers[:, rows[0]] -= lift[:, None] * axes[rows[0]]
    hand_rotations = rotations @ grasp.rotation
    wrists = np.einsum("tij,j->ti", rotations, grasp.wrist) + positions
    verts, joints = pose_hand(model, betas, fingers, hand_rotations, wrists)
    return HandMotion(betas, fingers, hand_rotations, wrists, verts, joints)


def frame_camera(
    extent: np.ndarray, rotations: np.ndarray, positions: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics K [3, 3] and a constant shift [3] of the scene that keep everything in the picture.

    Args:
        extent: [N, 3] points in the object's frame that must be seen in every frame.
        rotations, positions: the object's motion, [T, 3, 3] and [T, 3].
        width, height: pixels.
    """
    points = np.einsum("tij,nj->tni", rotations, extent) + positions[:, None]
    depth = points[..., 2:]
    rays = points[..., :2] / depth
    shift = np.append(-(rays.min(axis=(0, 1)) + rays.max(axis=(0, 1))) / 2, 0.0) * positions[:, 2].mean()
    reach = np.abs((points + shift)[..., :2] / depth).max(axis=(0, 1))
    half = np.array([width, height]) / 2
    focal = float((_FILL * half / reach).min())
    # Off-centre by a pixel or two, as real cameras are.
    center = half + np.array([0.013 * width, -0.011 * height])
    return np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1.0]]), shift

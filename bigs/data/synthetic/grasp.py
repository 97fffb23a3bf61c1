"""Placing a hand on an object: press the open palm to it, then close each finger until it touches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bigs.data.synthetic.objects import HandPlace, PointFunction

# MANO's joint numbers of each finger, in the order of the fingertips.
FINGERS: dict[str, tuple[int, int, int]] = {
    "thumb": (13, 14, 15),
    "index": (1, 2, 3),
    "middle": (4, 5, 6),
    "ring": (10, 11, 12),
    "pinky": (7, 8, 9),
}
# Largest bend of the knuckles, radians.
_MAX_BEND = np.array([1.45, 1.65, 1.1])
# Skin gives way by about this much, metres; fingers may go this deep into the object.
PRESS = 0.0007
# A MANO hand lies palm down.
_PALM = np.array([0.0, -1.0, 0.0])
_STEPS = 16
# The joints whose vertices touch first when a flat hand is pressed to the object.
_PALM_SIDE = (0, 1, 4, 7, 10, 13)


class HandLike(Protocol):
    """The interface of a hand model that is needed here; `bigs.hand.HandModel` has it."""

    faces: torch.Tensor
    lbs_weights: torch.Tensor
    hands_mean: torch.Tensor
    v_template: torch.Tensor
    tip_vertex_ids: torch.Tensor

    def rest_joints(self, betas: torch.Tensor) -> torch.Tensor: ...

    def __call__(
        self, betas: torch.Tensor, hand_pose: torch.Tensor, global_orient: torch.Tensor, wrist: torch.Tensor
    ) -> Any: ...


@dataclass(frozen=True)
class Grasp:
    """A hand on the object, in the object's frame."""

    fingers: np.ndarray  # [15, 3] axis-angle of every finger joint, no mean pose removed
    rotation: np.ndarray  # [3, 3]
    wrist: np.ndarray  # [3] metres


def pose_hand(
    model: HandLike, betas: np.ndarray, fingers: np.ndarray, rotations: np.ndarray, wrists: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [T, V, 3] and 21 joints [T, 21, 3] of finger rotations [T, 15, 3] and wrist poses."""
    matrices = Rotation.from_rotvec(fingers.reshape(-1, 3)).as_matrix().reshape(-1, 15, 3, 3)
    with torch.no_grad():
        output = model(
            *(torch.as_tensor(a, dtype=torch.float32) for a in (betas, matrices, rotations, wrists))
        )
    return output.vertices.double().numpy(), output.joints.double().numpy()


def rest_joints(model: HandLike, betas: np.ndarray) -> np.ndarray:
    """The 16 joints [16, 3] of the shaped hand at rest."""
    return model.rest_joints(torch.as_tensor(betas, dtype=torch.float32)).double().numpy()


def bend_axes(joints: np.ndarray) -> np.ndarray:
    """Unit axes [15, 3] about which each finger joint bends towards the palm, in the rest pose.

    Args:
        joints: [16, 3] rest joints; the last bone of a finger is taken to continue the one before.
    """
    axes = np.zeros((15, 3))
    for root, middle, last in FINGERS.values():
        for joint, (a, b) in zip(
            (root, middle, last), ((root, middle), (middle, last), (middle, last)), strict=True
        ):
            axis = np.cross(joints[b] - joints[a], _PALM)
            axes[joint - 1] = axis / np.linalg.norm(axis)
    return axes


def find_grasp(model: HandLike, betas: np.ndarray, place: HandPlace, distance: PointFunction) -> Grasp:
    """Press and close a hand at `place` on the object whose signed distance is `distance`."""
    normal, thumb = np.array(place.normal), np.array(place.thumb)
    rotation = np.stack([np.cross(normal, thumb), normal, thumb], axis=1)
    joints = rest_joints(model, betas)
    owner = model.lbs_weights.argmax(dim=1).numpy()
    search = _Search(model, betas, rotation, distance, owner, joints)
    fingers, wrist = search.press(np.array(place.point), normal)
    for name in ("index", "middle", "ring", "pinky"):
        fingers = search.close_finger(fingers, wrist, FINGERS[name])
    return Grasp(search.close_thumb(fingers, wrist), rotation, wrist)


@dataclass(frozen=True)
class _Search:
    model: HandLike
    betas: np.ndarray
    rotation: np.ndarray
    distance: PointFunction
    owner: np.ndarray  # [V] the joint that moves each vertex most
    joints: np.ndarray  # [16, 3] at rest

    def thumb_swing(self, share: float) -> np.ndarray:
        """Rotation of the thumb's base that carries it from its rest direction to straight above the palm.

        There it faces the fingers, pulled back towards the wrist so that the object has room.
        """
        bone = self.joints[15] - self.joints[13]
        bone = bone / np.linalg.norm(bone)
        reach = self.joints[4] - self.joints[0]
        goal = 0.9 * _PALM - 0.25 * reach / np.linalg.norm(reach) + np.array([0.0, 0.0, 0.35])
        goal /= np.linalg.norm(goal)
        axis = np.cross(bone, goal)
        return share * np.arccos(np.clip(bone @ goal, -1, 1)) * axis / np.linalg.norm(axis)

    def nearest(self, fingers: np.ndarray, wrists: np.ndarray, joints: tuple[int, ...]) -> np.ndarray:
        """Smallest signed distance [B] of the vertices that `joints` move, for poses [B, 15, 3]."""
        count = len(fingers)
        rotations = np.broadcast_to(self.rotation, (count, 3, 3)).copy()
        verts, _ = pose_hand(
            self.model, self.betas, fingers, rotations, np.broadcast_to(wrists, (count, 3)).copy()
        )
        mine = verts[:, np.isin(self.owner, joints)]
        return self.distance(mine.reshape(-1, 3)).reshape(count, -1).min(axis=1)

    def press(self, point: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Press the flat hand along -normal to the object near `point` until it touches.

        Which part of the palm meets the object, and how far the thumb is swung out of the way, are tried on
        a grid; the combination that lets the palm come nearest wins.

        Returns:
            Finger rotations [15, 3] and the wrist's position [3].
        """
        parts, swings = (a.ravel() for a in np.meshgrid(np.linspace(0.6, 0.95, 5), np.linspace(0.3, 0.95, 5)))
        fingers = np.zeros((len(parts), 15, 3))
        fingers[:, FINGERS["thumb"][0] - 1] = [self.thumb_swing(share) for share in swings]
        offsets = (parts[:, None] * (self.joints[4] - self.joints[0])) @ self.rotation.T
        offsets -= (offsets @ normal)[:, None] * normal
        wrists = point - offsets + 0.25 * normal
        for _ in range(_STEPS):
            gaps = self.nearest(fingers, wrists, _PALM_SIDE) + PRESS
            wrists = wrists - gaps[:, None] * normal
            if np.abs(gaps).max() < 1e-5:
                break
        best = (wrists @ normal).argmin()
        return fingers[best], wrists[best]

    def close_finger(
        self, fingers: np.ndarray, wrist: np.ndarray, joints: tuple[int, int, int]
    ) -> np.ndarray:
        """Bend the whole finger until it touches, then its outer joints until they do."""
        bend = bend_axes(self.joints) * np.repeat(_MAX_BEND[None], 5, axis=0).reshape(15, 1)
        for moving in (joints, joints[1:], joints[2:]):
            step = np.zeros((15, 3))
            rows = np.array(moving) - 1
            # The remaining range of each joint.
            step[rows] = bend[rows] - fingers[rows]
            fingers = fingers + self.largest_safe(fingers, step, wrist, moving) * step
        return fingers

    def largest_safe(
        self, fingers: np.ndarray, step: np.ndarray, wrist: np.ndarray, joints: tuple[int, ...]
    ) -> float:
        """The largest share in [0, 1] of `step` before those joints' vertices are deeper than PRESS."""
        low, high = 0.0, 1.0
        for _ in range(2):
            shares = np.linspace(low, high, _STEPS)
            gaps = self.nearest(fingers + shares[:, None, None] * step, wrist, joints)
            deep = np.flatnonzero(gaps < -PRESS)
            if deep.size == 0:
                return high
            if deep[0] == 0:
                return low
            low, high = shares[deep[0] - 1], shares[deep[0]]
        return low

    def close_thumb(self, fingers: np.ndarray, wrist: np.ndarray) -> np.ndarray:
        """Try how far the thumb swings out; from each, close it towards the fingers; keep the best touch."""
        rows = np.array(FINGERS["thumb"]) - 1
        toward = self.joints[4] - self.joints[0]
        best, best_score = fingers, np.inf
        for share in np.linspace(0.2, 1.0, 7):
            swing = Rotation.from_rotvec(self.thumb_swing(share))
            trial = fingers.copy()
            trial[rows[0]] = swing.as_rotvec()
            trial[rows[1:]] = 0
            start = self.nearest(trial[None], wrist, FINGERS["thumb"])[0]
            # The outer joints bend about the axis that turns the swung thumb towards the fingers.
            bone = swing.apply(self.joints[15] - self.joints[13])
            axis = swing.inv().apply(np.cross(bone, toward))
            step = np.zeros((15, 3))
            step[rows[1:]] = axis / np.linalg.norm(axis) * np.array([[0.8], [1.0]])
            for moving in (rows[1:], rows[2:]):
                part = np.zeros((15, 3))
                part[moving] = step[moving] - trial[moving]
                trial = trial + self.largest_safe(trial, part, wrist, tuple(moving + 1)) * part
            gap = self.nearest(trial[None], wrist, FINGERS["thumb"])[0]
            tip = self.nearest(trial[None], wrist, FINGERS["thumb"][2:])[0]
            # A thumb that starts inside the object is no grasp; otherwise the closest fingertip wins.
            score = abs(tip) + 10 * max(0.0, -PRESS - min(gap, start)) + 0.004 * share
            if score < best_score:
                best, best_score = trial, score
        return best

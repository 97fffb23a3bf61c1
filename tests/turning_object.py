"""A dotted egg that turns before a camera: exact poses, the features to be found, and their matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.motion.features import FrameFeatures
from bigs.motion.models import PartialModel
from bigs.motion.object_map import MapConfig, ObjectMap
from bigs.motion.tracks import Tracks, join_matches

K = np.array([[1000.0, 0.0, 240.0], [0.0, 1000.0, 180.0], [0.0, 0.0, 1.0]])
AXES = np.array([0.05, 0.09, 0.035])


@dataclass(frozen=True)
class TurningObject:
    """What is true, and what a feature detector would make of it."""

    rotations: np.ndarray  # [T, 3, 3]
    transl: np.ndarray  # [T, 3]
    points: np.ndarray  # [N, 3]
    features: list[FrameFeatures]
    ids: list[np.ndarray]  # T arrays: which point each feature shows

    def matches(self, overlap: int = 10) -> dict[tuple[int, int], np.ndarray]:
        """The true matches of each frame with the `overlap` next ones."""
        found = {}
        for a in range(len(self.ids)):
            for b in range(a + 1, min(a + 1 + overlap, len(self.ids))):
                _, first, second = np.intersect1d(self.ids[a], self.ids[b], return_indices=True)
                found[a, b] = np.stack([first, second], axis=1)
        return found

    def tracks(self) -> Tracks:
        return join_matches(self.matches(), [len(ids) for ids in self.ids])

    def map(self) -> ObjectMap:
        return ObjectMap(self.features, self.tracks(), K, MapConfig())

    def model(self, frames: Sequence[int], mirrored: bool = False) -> PartialModel:
        """The true model of some frames, or its mirror image in depth; in another frame and unit."""
        frames = np.asarray(frames)
        turn = Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix()
        rotations, points = self.rotations[frames] @ turn.T, self.points @ turn.T
        if mirrored:
            flip = np.diag([1.0, 1.0, -1.0])
            rotations, points = flip @ rotations @ flip, points @ flip
        nothing = np.zeros(0, dtype=int)
        return PartialModel(
            frames, rotations, 3.0 * self.transl[frames], 3.0 * points, nothing, nothing, nothing
        )


def turning_object(
    frames: int = 40,
    points: int = 700,
    speed: float = 5.0,
    noise: float = 0.15,
    hidden: Sequence[int] = (),
    shown_there: int = 0,
    seed: int = 0,
) -> TurningObject:
    """An egg of 10 x 18 x 7 cm at 70 cm, `speed` degrees a frame about a slowly changing axis.

    Args:
        frames, points, noise: how many, and the features' standard deviation in pixels.
        hidden: frames in which a hand covers it but for `shown_there` points.
    """
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((points, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    places = normals * AXES
    outward = normals / AXES
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    descriptors = rng.standard_normal((points, 128)) ** 2
    time = np.arange(frames)
    axis = np.stack([0.3 * np.sin(0.05 * time), np.ones(frames), 0.3 * np.cos(0.06 * time)], axis=1)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    rotation = np.eye(3)
    rotations = []
    for step in Rotation.from_rotvec(np.radians(speed) * axis).as_matrix():
        rotations.append(rotation)
        rotation = step @ rotation
    transl = np.stack(
        [0.02 * np.sin(0.1 * time), 0.01 * np.cos(0.1 * time), 0.7 + 0.02 * np.sin(0.07 * time)], axis=1
    )
    features, ids = [], []
    for t in range(frames):
        cam = places @ rotations[t].T + transl[t]
        towards = -cam / np.linalg.norm(cam, axis=1, keepdims=True)
        seen = np.flatnonzero(((outward @ rotations[t].T) * towards).sum(1) > 0.35)
        seen = rng.permutation(seen)[: shown_there if t in hidden else None]
        pixels = cam[seen, :2] / cam[seen, 2:] * 1000.0 + (240.0, 180.0)
        pixels = pixels + noise * rng.standard_normal(pixels.shape)
        described = descriptors[seen] * rng.uniform(0.8, 1.2, (len(seen), 128))
        described *= 512.0 / np.linalg.norm(described, axis=1, keepdims=True).clip(1e-9)
        sizes = np.full(len(seen), 2.0)
        features.append(FrameFeatures(pixels, sizes, np.zeros(len(seen)), described.astype(np.uint8)))
        ids.append(seen)
    return TurningObject(np.array(rotations), transl, places, features, ids)


def rotation_errors(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Degrees [T] between rotations after the one turn of the object frame that fits best."""
    between = Rotation.from_matrix(found.transpose(0, 2, 1) @ true)
    return np.degrees((between * between.mean().inv()).magnitude())

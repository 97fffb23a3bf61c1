"""The random clip that the loader's tests write: too small to mean anything, complete enough to be read."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.data.base import HandTrack, ObjectTrack
from bigs.data.formats.annotation import Annotation, ObjectTruth

FRAMES = 5
WIDTH, HEIGHT = 24, 16
SHIFT = np.array([0.01, -0.02, -0.4])
K = np.array([[50.0, 0.0, 12.5], [0.0, 52.0, 7.5], [0.0, 0.0, 1.0]])


def random_hand(rng: np.random.Generator) -> HandTrack:
    return HandTrack(
        global_orient=rng.normal(size=(FRAMES, 3)),
        hand_pose=0.4 * rng.normal(size=(FRAMES, 15, 3)),
        transl=rng.normal(size=(FRAMES, 3)),
        betas=rng.normal(size=10),
        valid=np.ones(FRAMES, dtype=bool),
    )


def random_object(rng: np.random.Generator) -> ObjectTrack:
    metric_from_canon = np.diag([0.12, 0.12, 0.12, 1.0])
    metric_from_canon[:3, 3] = rng.normal(size=3)
    return ObjectTrack(
        points=rng.normal(size=(30, 3)),
        colors=rng.integers(0, 256, (30, 3)) / 255,
        scale=0.08,
        metric_from_canon=metric_from_canon,
        rotations=Rotation.random(FRAMES, random_state=rng).as_matrix(),
        transl=rng.normal(size=(FRAMES, 3)),
        valid=np.ones(FRAMES, dtype=bool),
    )


def small_masks() -> list[np.ndarray]:
    """Every entity in every frame, but no left hand in frame 2."""
    masks = []
    for t in range(FRAMES):
        mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
        mask[2:6, 2:8], mask[8:12, 10:20] = 150, 50
        if t != 2:
            mask[12:15, 2:6] = 250
        masks.append(mask)
    return masks


def small_annotation() -> Annotation:
    """Five frames of two random hands and a tetrahedron of 10 cm, half a metre away."""
    rng = np.random.default_rng(5)
    return Annotation(
        name="small",
        frame_names=tuple(f"{t:05d}.jpg" for t in range(FRAMES)),
        width=WIDTH,
        height=HEIGHT,
        K=K,
        cam_from_world=np.repeat(np.eye(4)[None], FRAMES, axis=0),
        hands={"right": random_hand(rng), "left": random_hand(rng)},
        object=ObjectTruth(
            verts=0.1 * np.vstack([np.zeros(3), np.eye(3)]),
            faces=np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
            rotations=np.repeat(np.eye(3)[None], FRAMES, axis=0),
            transl=np.repeat([[0.0, 0.0, 0.5]], FRAMES, axis=0),
            valid=np.ones(FRAMES, dtype=bool),
        ),
    )

"""What a user of `bigs preprocess` has, and the object's true motion as another tool would supply it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from bigs.data.ground_truth import load_ground_truth
from bigs.preprocess.artefacts import Alignment, ObjectSfm, write_alignment, write_object_sfm

# Structure from motion's unit in metres, for artefacts made from the truth.
UNIT = 0.4


class Given(NamedTuple):
    """What a user has."""

    pictures: Path
    masks: Path
    keypoints: Path
    camera: tuple[str, ...]  # --K and its numbers
    truth: Path


def place_true_object(clip: Path, truth: Path) -> None:
    """Put the object's true motion where the object steps leave theirs, as another tool would."""
    stored = np.load(truth / "gt.npz")
    points = load_ground_truth(truth).object_verts
    assert points is not None
    frames = len(points)
    canonical = (points[0] - stored["obj_t"][0]) @ stored["obj_R"][0] / UNIT
    centre = 0.5 * (canonical.min(0) + canonical.max(0))
    radius = np.linalg.norm(canonical - centre, axis=1).max()
    norm_mat = np.diag([1 / radius, 1 / radius, 1 / radius, 1.0])
    norm_mat[:3, 3] = -centre / radius
    every = np.ones(frames, dtype=bool)
    colors = np.full(canonical.shape, 120, dtype=np.uint8)
    processed = clip / "processed"
    processed.mkdir(parents=True, exist_ok=True)
    sfm = ObjectSfm(stored["obj_R"], stored["obj_t"] / UNIT, every, every * 1.0, canonical, colors, norm_mat)
    write_object_sfm(processed / "object_sfm.npz", sfm, "")
    alignment = Alignment(UNIT, stored["obj_R"], stored["obj_t"], every, {})
    write_alignment(processed / "aligned.npz", alignment, "")

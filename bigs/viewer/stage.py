"""What the live viewer shows, as plain arrays and functions of the frame, without models or files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from bigs.types import USUAL_FPS

# (subject, knob) -> degrees; missing knobs are 0.
Pose = Mapping[tuple[str, str], float]


class Splats(NamedTuple):
    """Gaussians ready to be drawn: metres, OpenCV camera frame."""

    means: np.ndarray  # [N, 3]
    covariances: np.ndarray  # [N, 3, 3]
    colors: np.ndarray  # [N, 3] in [0, 1]
    opacities: np.ndarray  # [N]


class Mesh(NamedTuple):
    """Triangles: metres, OpenCV camera frame."""

    verts: np.ndarray  # [V, 3]
    faces: np.ndarray  # [F, 3]


class Subject(NamedTuple):
    """A hand or the object at one time."""

    splats: Splats
    mesh: Mesh


@dataclass(frozen=True)
class Stage:
    """One clip to look at."""

    title: str
    frames: int
    K: np.ndarray  # [3, 3]
    width: int
    height: int
    middle: np.ndarray  # [3] what to look at, metres
    colors: Mapping[str, tuple[int, int, int]]  # every subject and its colour
    show: Callable[[int, Pose], Mapping[str, Subject]]  # frame, pose -> every subject
    knobs: Mapping[str, Mapping[str, tuple[int, int]]] = field(default_factory=dict)  # degrees from, to
    image: Callable[[int], np.ndarray] | None = None  # frame -> [H, W, 3] uint8
    truth: Callable[[int], Mapping[str, Mesh]] | None = None  # frame -> ground truth of every subject
    grasps: str = ""  # when hands hold the object, an SVG element
    fps: float = USUAL_FPS  # frames a second

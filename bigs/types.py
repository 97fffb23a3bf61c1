"""The few plain types that several packages share. Tuples of tensors and arrays, no behaviour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

Side = Literal["right", "left"]
SIDES: tuple[Side, ...] = ("right", "left")

Entity = Literal["right", "left", "object"]
ENTITIES: tuple[Entity, ...] = ("right", "left", "object")

# Values of the label masks of a clip, as HOLD's and the HANDS challenge's `build` folders have them.
MASK_VALUES: dict[Entity, int] = {"object": 50, "right": 150, "left": 250}

# Frames a second of clips and pictures that do not say. Plans are written for it.
USUAL_FPS = 30.0


class Gaussians(NamedTuple):
    """A set of 3D Gaussians (paper Eq. 1); leading batch axes are allowed."""

    means: torch.Tensor  # [..., N, 3] metres
    quats: torch.Tensor  # [..., N, 4] w x y z, need not be unit
    scales: torch.Tensor  # [..., N, 3] standard deviations, metres
    opacities: torch.Tensor  # [..., N] in [0, 1]
    colors: torch.Tensor  # [..., N, D]


class Cameras(NamedTuple):
    """Pinhole cameras, OpenCV axes; pixel (column i, row j) has its centre at (i + 0.5, j + 0.5)."""

    viewmats: torch.Tensor  # [C, 4, 4] world to camera
    Ks: torch.Tensor  # [C, 3, 3]
    width: int
    height: int


class RenderOutput(NamedTuple):
    """What `bigs.raster.rasterization` returns; unpacks as gsplat's three values do."""

    colors: torch.Tensor  # [..., C, H, W, D]
    alphas: torch.Tensor  # [..., C, H, W, 1]
    info: dict[str, Any]


@dataclass(frozen=True)
class HandObjectTrajectory:
    """Meshes and joints of one clip, reconstructed or true: metres, OpenCV camera frame of each frame.

    A clip without a hand (or without an object) simply lacks the key (or holds None).
    """

    name: str  # sequence name
    frame_names: tuple[str, ...]  # T names, as the clip lists them
    joints: dict[
        Side, np.ndarray
    ]  # [T, 21, 3]: 16 in MANO order, then tips of thumb, index, middle, ring, pinky
    verts: dict[Side, np.ndarray]  # [T, V, 3]
    faces: dict[Side, np.ndarray]  # [F, 3]
    object_verts: np.ndarray | None  # [T, Vo, 3]
    object_faces: np.ndarray | None  # [Fo, 3]; None for a bare point set

"""Symmetries of an object of which one side was seen: mirror planes and axes of revolution.

A symmetry carries what was seen to other places. There it may meet seen surface of the same kind (support),
fall where the clip shows that nothing is (contradiction), or fall where nobody looked. After Thrun and
Wegbreit, "Shape from symmetry" (2005): the last are no evidence against it, and what it fills.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import scipy.ndimage
import scipy.spatial
from scipy.spatial.transform import Rotation

# An axis of revolution is tested by rotations of these shares of a full turn.
TURNS = 12


class SeenSurface(NamedTuple):
    """Samples of what a clip has seen of an object."""

    points: np.ndarray  # [N, 3] metres
    normals: np.ndarray  # [N, 3] unit, outward
    colors: np.ndarray  # [N, 3] in [0, 1]


# Which of the points [N, 3] lie where the clip shows no object.
IsEmpty = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class EmptySpace:
    """Where the clip shows no object, by a grid that is above one half there; beyond it is none."""

    values: np.ndarray  # [X, Y, Z]
    origin: np.ndarray  # [3] position of values[0, 0, 0]
    spacing: float  # metres between neighbours

    def __call__(self, points: np.ndarray) -> np.ndarray:
        place = ((points - self.origin) / self.spacing).T
        return scipy.ndimage.map_coordinates(self.values, place, order=1, mode="constant", cval=1.0) > 0.5


@dataclass(frozen=True)
class Symmetry:
    """A mirror plane, or an axis about which any turn leaves the object the same."""

    kind: Literal["plane", "axis"]
    point: np.ndarray  # [3] on the plane or axis, metres
    direction: np.ndarray  # [3] unit: the plane's normal, the axis's direction
    support: float = 0.0
    contradiction: float = 0.0

    def images(self, surface: SeenSurface) -> list[SeenSurface]:
        """The surface carried by the symmetry: one copy, or eleven turned by 30 degrees each."""
        if self.kind == "plane":
            matrices = [np.eye(3) - 2.0 * np.outer(self.direction, self.direction)]
        else:
            angles = np.arange(1, TURNS) * (2.0 * np.pi / TURNS)
            matrices = list(Rotation.from_rotvec(angles[:, None] * self.direction).as_matrix())
        return [
            SeenSurface(
                (surface.points - self.point) @ matrix.T + self.point,
                surface.normals @ matrix.T,
                surface.colors,
            )
            for matrix in matrices
        ]

    def mirrored(self, plane: Symmetry) -> Symmetry:
        """What a mirror plane makes of it."""
        normal = plane.direction
        point = self.point - 2.0 * ((self.point - plane.point) @ normal) * normal
        return Symmetry(self.kind, point, self.direction - 2.0 * (self.direction @ normal) * normal)

    def moved(self, x: np.ndarray, size: float) -> Symmetry:
        """A plane shifted by x[1] * size along its normal, an axis by x[:2] * size; turned by x[2:]."""
        first, second = across(self.direction)
        direction = self.direction + x[2] * first + x[3] * second
        shift = x[1] * self.direction if self.kind == "plane" else x[0] * first + x[1] * second
        return Symmetry(self.kind, self.point + size * shift, direction / np.linalg.norm(direction))


def across(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors [3] at right angles to a unit direction [3] and to each other."""
    helper = np.eye(3)[np.argmin(np.abs(direction))]
    first = np.cross(direction, helper)
    first = first / np.linalg.norm(first)
    return first, np.cross(direction, first)


def completed(
    surface: SeenSurface, symmetries: Iterable[Symmetry], is_empty: IsEmpty, gap: float
) -> SeenSurface:
    """The seen surface with what its symmetries add where nothing was seen.

    Symmetries are applied one after the other, so that two mirror planes fill all four quarters. A carried
    point is added when it is further than `gap` metres from all that is there, and not in empty space.
    """
    whole = surface
    for symmetry in symmetries:
        for image in symmetry.images(whole):
            distance, _ = scipy.spatial.cKDTree(whole.points).query(image.points)
            new = distance > gap
            new[new] &= ~is_empty(image.points[new])
            whole = SeenSurface(
                np.concatenate([whole.points, image.points[new]]),
                np.concatenate([whole.normals, image.normals[new]]),
                np.concatenate([whole.colors, image.colors[new]]),
            )
    return whole

"""What many views say about an object's shape, in one pass of compiled code each, in numpy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

import bigs._raster as _raster


def _doubles(values: ArrayLike) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float64)


class Poses(NamedTuple):
    """The object's pose in T pictures of one camera: x = rotation p + centre."""

    K: np.ndarray  # [3, 3] intrinsics
    rotations: np.ndarray  # [T, 3, 3]
    centers: np.ndarray  # [T, 3]

    def arrays(self) -> tuple[tuple[float, float, float, float], np.ndarray, np.ndarray]:
        """As the compiled code has them."""
        camera = tuple(float(self.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return camera, _doubles(self.rotations).reshape(-1, 9), _doubles(self.centers)  # type: ignore[return-value]


def cone_distances(
    silhouettes: np.ndarray, poses: Poses, points: np.ndarray, order: np.ndarray, agreeing: int, stop: float
) -> np.ndarray:
    """Distances [N] of points [N, 3] to what the cones over silhouettes have in common.

    Args:
        silhouettes: [T, H, W] signed distances to their borders in pixels, negative inside.
        poses: of the pictures.
        points: in the object's frame.
        order: [T] in which pictures are looked at.
        agreeing: how many pictures must say that a point is outside.
        stop: points found to be further outside are not looked at again.
    """
    silhouettes = np.ascontiguousarray(silhouettes, dtype=np.float32)
    return _raster.cone_distances(
        silhouettes, poses.arrays(), _doubles(points), [int(t) for t in order], agreeing, float(stop)
    )


def times_seen(
    shown: np.ndarray,
    poses: Poses,
    points: np.ndarray,
    normals: np.ndarray,
    surface: np.ndarray,
    least_cosine: float,
    tolerance: float,
) -> np.ndarray:
    """In how many pictures [N] surface points [N, 3] show.

    Args:
        shown: [T, H, W] bool, the pixels that count.
        poses: of the pictures.
        points, normals: of the surface, unit and outward.
        surface: [M, 3] samples that may hide the points.
        least_cosine: of the angle between a normal and the way to the camera.
        tolerance: by which a point may lie behind the nearest surface of its pixel.
    """
    shown = np.ascontiguousarray(shown)
    points, normals, surface = map(_doubles, (points, normals, surface))
    return _raster.times_seen(shown, poses.arrays(), points, normals, surface, least_cosine, tolerance)


def times_empty(
    shown: np.ndarray, poses: Poses, points: np.ndarray, surface: np.ndarray, tolerance: float
) -> np.ndarray:
    """In how many pictures [N] points [N, 3] would hide surface [M, 3] that shows, by more than a tolerance.

    `shown` [T, H, W] (bool) says where it does.
    """
    shown = np.ascontiguousarray(shown)
    return _raster.times_empty(shown, poses.arrays(), _doubles(points), _doubles(surface), tolerance)


def beyond_planes(points: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """The largest signed distance [N] of points [N, 3] to planes [M, 4]: unit normal and offset."""
    return _raster.beyond_planes(_doubles(points), _doubles(planes))


def border_distances(inside: np.ndarray) -> np.ndarray:
    """Signed distances [H, W] in pixels to the border of a mask [H, W], negative inside.

    Exact (Meijster et al., 2000), from pixels' centres, which are half a pixel from a border beside them.
    Without a border all are about as far away as width and height together.
    """
    return _raster.border_distances(np.ascontiguousarray(inside)).reshape(inside.shape)


class SymmetryJudge:
    """Judges symmetries of a surface: rows [M, 6] of a point and a direction, of axes [M] (bool) or planes.

    Args:
        surface: points, normals and colours [N, 3].
        empty: [X, Y, Z], above one half where there is no object; beyond it is none.
        origin, spacing: of that grid.
        reach: a carried sample meets another that is nearer ...
        least_cosine: ... if the cosine between their normals is larger.
        turns: axes are judged by turns of this share of the circle, ...
        every: ... and by every so many samples.
    """

    def __init__(
        self,
        surface: tuple[np.ndarray, np.ndarray, np.ndarray],
        empty: np.ndarray,
        origin: np.ndarray,
        spacing: float,
        reach: float,
        least_cosine: float,
        turns: int,
        every: int,
    ) -> None:
        points, normals, colors = map(_doubles, surface)
        self._judge = _raster.SymmetryJudge(
            (points, normals, colors),
            _doubles(empty),
            tuple(map(float, origin)),
            float(spacing),
            reach,
            least_cosine,
            turns,
            every,
        )

    def agreement(self, axes: list[bool], symmetries: np.ndarray) -> np.ndarray:
        """[M, 3]: support and contradiction as shares of what is carried, mean difference of colours."""
        return self._judge.agreement(axes, _doubles(symmetries)).reshape(-1, 3)

    def refined(self, axes: list[bool], symmetries: np.ndarray, size: float) -> np.ndarray:
        """Each symmetry [M, 6] moved to where carried samples lie on the planes of those they meet."""
        return self._judge.refined(axes, _doubles(symmetries), size).reshape(-1, 6)

"""Which part of the object's closed surface the clip supports; the rest is a guess."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.spatial

from bigs.geometry.coverage import ObjectViews, times_seen
from bigs.geometry.mesh import sample_surface
from bigs.geometry.surface import DistanceGrid
from bigs.threads import thread_count

# Number of surface samples that are tested, and of those that may occlude them.
_SAMPLES, _OCCLUDERS = 4000, 20_000


class SurfaceSamples(NamedTuple):
    """Even samples of a closed surface."""

    points: np.ndarray  # [N, 3] metres
    normals: np.ndarray  # [N, 3] unit, outward
    seen: np.ndarray  # [N] bool: the clip shows it


def seen_samples(
    views: ObjectViews, verts: np.ndarray, faces: np.ndarray, least_frames: int, tolerance: float
) -> SurfaceSamples:
    """Samples of a closed surface, and which of them show in enough frames.

    Args:
        views: the frames that count.
        verts: [V, 3] metres.
        faces: [F, 3].
        least_frames: frames that must show a sample, or all if there are fewer.
        tolerance: metres by which poses are wrong; surface that is nearer by less does not hide.
    """
    occluders, _ = sample_surface(verts, faces, _OCCLUDERS)
    points, normals = sample_surface(verts, faces, _SAMPLES)
    frames = times_seen(views, points, normals, occluders, tolerance)
    return SurfaceSamples(points, normals, frames >= min(least_frames, len(views.shown)))


class Support:
    """Distance of points from anything that the clip shows of the object."""

    def __init__(self, samples: SurfaceSamples, points: np.ndarray) -> None:
        """`points` [M, 3] are the clip's own, metres; at least one of them, or one seen sample."""
        self._samples = scipy.spatial.cKDTree(samples.points)
        self._shown = scipy.spatial.cKDTree(np.concatenate([samples.points[samples.seen], points]))
        self._of_sample = self._shown.query(samples.points)[0]

    def guessed(self, reach: float) -> float:
        """The share of the surface that lies further than `reach` metres from what is shown."""
        return float((self._of_sample >= reach).mean())

    def known_part(self, verts: np.ndarray, faces: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """The part of a mesh that lies within `reach` metres of what is shown.

        Args:
            verts: [V, 3] metres.
            faces: [F, 3].
            reach: metres.

        Returns:
            Indices [V'] of its vertices, and faces [F', 3] among these.
        """
        near = self._shown.query(verts)[0] < reach
        kept = faces[near[faces].all(axis=1)]
        used, kept = np.unique(kept, return_inverse=True)
        return used, kept.reshape(-1, 3)

    def without_guesses(self, grid: DistanceGrid, reach: float) -> DistanceGrid:
        """The signed distance without what lies behind surface further than `reach` from what is shown.

        What lies deep inside an object that is shown all around stays inside.
        """
        corners = grid.points()
        values = grid.values.ravel().copy()
        guessed = self._of_sample[self._samples.query(corners, workers=thread_count())[1]] >= reach
        beyond = self._shown.query(corners[guessed])[0] - reach
        values[guessed] = np.maximum(values[guessed], beyond)
        return DistanceGrid(values.reshape(grid.values.shape), grid.origin, grid.spacing)

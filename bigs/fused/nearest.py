"""The nearest of many points for each of many places."""

from __future__ import annotations

import numpy as np

import bigs._raster as _raster


class NearestPoints:
    """Points among which nearest ones are sought, any number of times, on all threads."""

    def __init__(self, points: np.ndarray) -> None:
        """`points` [M, 3], at least one.

        Raises:
            ValueError: there is none.
        """
        self._tree = _raster.NearestPoints(np.ascontiguousarray(points, dtype=np.float64))

    def of(self, places: np.ndarray, guesses: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Distances [...] and indices [...] of the points that are nearest to places [..., 3].

        Args:
            places: any number of them. One that is not finite has an infinite distance.
            guesses: [...] uint32 indices, such as those of places nearby: they save time and change nothing,
                except which of two points at the same distance is taken.
        """
        flat = np.ascontiguousarray(places, dtype=np.float64).reshape(-1, 3)
        distances, indices = self._tree.of(
            flat, None if guesses is None else np.ascontiguousarray(guesses).ravel()
        )
        return distances.reshape(places.shape[:-1]), indices.reshape(places.shape[:-1])

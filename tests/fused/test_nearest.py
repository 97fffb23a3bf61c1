"""Nearest points by compiled code against scipy's, and against what they are by definition."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from bigs.fused.nearest import NearestPoints


@pytest.mark.parametrize("away", [0.0, 30.0])
@pytest.mark.parametrize("count", [1, 2, 30, 3000])
def test_as_scipy_finds_them(count: int, away: float) -> None:
    """Also where all places are far from all points, and one box of them is as near as another."""
    rng = np.random.default_rng(count)
    points = rng.normal(size=(count, 3)) * [1.0, 0.3, 0.0]
    places = np.concatenate([rng.normal(size=(500, 3)), points[:50], [[90.0, 0.0, -1.0]]]) + away
    distances, indices = NearestPoints(points).of(places)
    np.testing.assert_array_equal(distances, cKDTree(points).query(places)[0])
    np.testing.assert_allclose(np.linalg.norm(points[indices] - places, axis=1), distances, rtol=1e-14)


def test_a_guess_changes_no_distance() -> None:
    rng = np.random.default_rng(1)
    points, places = rng.normal(size=(800, 3)), rng.normal(size=(4, 100, 3))
    tree = NearestPoints(points)
    distances, indices = tree.of(places)
    assert distances.shape == indices.shape == (4, 100)
    for guesses in (indices, rng.integers(0, 800, (4, 100), dtype=np.uint32)):
        again, found = tree.of(places, guesses)
        np.testing.assert_array_equal(again, distances)
        np.testing.assert_array_equal(found, indices)


def test_what_is_not_finite_is_infinitely_far() -> None:
    distances, _ = NearestPoints(np.eye(3)).of(np.array([[np.nan, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_array_equal(distances, [np.inf, 0.0])


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        NearestPoints(np.zeros((0, 3)))
    tree = NearestPoints(np.eye(3))
    with pytest.raises(ValueError, match="guesses"):
        tree.of(np.eye(3), np.zeros(2, dtype=np.uint32))
    with pytest.raises(ValueError, match="indices below 3, found 3"):
        tree.of(np.eye(3), np.full(3, 3, dtype=np.uint32))

"""Distances to a mask's border against scipy's, which are exact, and where they are known."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage
from hypothesis import given
from hypothesis import strategies as st

from bigs.fused.shape import border_distances


def by_scipy(mask: np.ndarray) -> np.ndarray:
    inside, outside = (scipy.ndimage.distance_transform_edt(side) for side in (mask, ~mask))
    return np.where(mask, 0.5 - inside, outside - 0.5).astype(np.float32)


@given(st.integers(1, 40), st.integers(1, 40), st.floats(0.02, 0.98), st.integers(0, 2**32 - 1))
def test_random_masks(height: int, width: int, share: float, seed: int) -> None:
    mask = np.random.default_rng(seed).random((height, width)) < share
    if mask.all() or not mask.any():
        return
    np.testing.assert_array_equal(border_distances(mask), by_scipy(mask))


@pytest.mark.parametrize("shape", [(121, 83), (1, 64), (64, 1), (37, 300)])
def test_few_large_regions(shape: tuple[int, int]) -> None:
    """Pixels far from a border, rows and columns without one, and regions that touch the edge."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        smooth = scipy.ndimage.gaussian_filter(rng.normal(size=shape), rng.uniform(1.0, 12.0))
        mask = smooth > np.quantile(smooth, rng.uniform(0.1, 0.95))
        np.testing.assert_array_equal(border_distances(mask), by_scipy(mask))


def test_the_border_lies_between_pixels() -> None:
    mask = np.zeros((5, 9), dtype=bool)
    mask[:, :4] = True
    np.testing.assert_array_equal(border_distances(mask), np.tile(np.arange(9) - 3.5, (5, 1)))


@pytest.mark.parametrize(("value", "sign"), [(True, -1.0), (False, 1.0)])
def test_without_a_border_all_is_far_away(value: bool, sign: float) -> None:
    distances = border_distances(np.full((5, 9), value))
    assert (sign * distances >= 9.0).all() and np.isfinite(distances).all()


def test_a_part_of_a_larger_mask() -> None:
    mask = np.random.default_rng(1).random((30, 40)) < 0.5
    np.testing.assert_array_equal(border_distances(mask[3:17:2, 5:33]), by_scipy(mask[3:17:2, 5:33]))


@pytest.mark.parametrize("shape", [(0, 0), (0, 7), (7, 0)])
def test_nothing_has_no_distances(shape: tuple[int, int]) -> None:
    assert border_distances(np.zeros(shape, dtype=bool)).shape == shape


def test_a_mask_has_two_axes() -> None:
    with pytest.raises(ValueError, match=r"expected the shape \(H, W\), found \[2, 3, 4\]"):
        border_distances(np.zeros((2, 3, 4), dtype=bool))

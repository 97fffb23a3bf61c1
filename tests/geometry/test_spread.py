"""A few of many, evenly."""

from __future__ import annotations

import numpy as np
import pytest

from bigs.geometry.spread import spread


@pytest.mark.parametrize(("count", "most"), [(60, 16), (300, 20), (7, 3), (17, 16), (2, 2)])
def test_both_ends_are_among_them_and_gaps_are_even(count: int, most: int) -> None:
    found = spread(count, most)
    assert len(found) == most and found[0] == 0 and found[-1] == count - 1
    gaps = np.diff(found)
    assert gaps.min() > 0 and np.ptp(gaps) <= 1


@pytest.mark.parametrize(
    ("count", "most", "expected"), [(3, 16, [0, 1, 2]), (1, 5, [0]), (0, 5, []), (9, 1, [0])]
)
def test_few_are_all(count: int, most: int, expected: list[int]) -> None:
    assert spread(count, most).tolist() == expected

"""The rate of clips that do not say: what their frames' numbers leave out."""

from __future__ import annotations

import pytest

from bigs.data.frame_rate import rate_by_names

NUMBERED = [f"{t:05d}.jpg" for t in range(100, 130)]


@pytest.mark.parametrize(
    ("names", "rate"),
    [
        (NUMBERED, 30.0),
        (NUMBERED[::3], 10.0),
        # A few dropped frames more change nothing.
        ([*NUMBERED[:10], *NUMBERED[13:]], 30.0),
        ([f"take2_frame{t}.png" for t in range(0, 60, 2)], 15.0),
        ([f"{t}.png" for t in range(0, 100, 10)], 3.0),
        ([f"{t}.png" for t in range(0, 110, 11)], 30.0),
        # No frame numbers: times, other pictures, an order of their own, none at all.
        ([f"{t}.png" for t in range(0, 3000, 100)], 30.0),
        (NUMBERED[::-2], 30.0),
        (["a.png", "b.png", "c.png"], 30.0),
        ([*NUMBERED, "last.png"], 30.0),
        (["3.png", "3.png", "3.png"], 30.0),
        (["1" * 400 + ".png", "2" * 400 + ".png"], 30.0),
        (NUMBERED[:1], 30.0),
        ([], 30.0),
    ],
)
def test_names_that_leave_numbers_out(names: list[str], rate: float) -> None:
    assert rate_by_names(names) == pytest.approx(rate)

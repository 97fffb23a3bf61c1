"""The map of directions: shares that follow from geometry, and colours where they belong."""

import numpy as np
import pytest

from bigs.viewer.coverage import coverage_map

TOP, BOTTOM = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
RED = (214, 96, 77)


def share(*directions, visible=None):
    directions = np.array(directions, dtype=float)
    return coverage_map(directions, np.ones(len(directions), bool) if visible is None else visible)


def test_one_camera_sees_a_cap_of_sixty_degrees():
    """The cap's part of the sphere is (1 - cos 60°) / 2."""
    assert share(TOP).share == pytest.approx(0.25, abs=0.002)
    assert share((3.0, 0.0, 0.0)).share == pytest.approx(0.25, abs=0.002)
    assert share(TOP, TOP).share == share(TOP).share


def test_caps_that_do_not_meet_add_up():
    assert share(TOP, BOTTOM).share == pytest.approx(0.5, abs=0.003)


def test_from_all_sides_everything_is_seen():
    six = [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
    found = share(*six)
    assert found.share == pytest.approx(1.0, abs=0.001)
    assert not (np.asarray(found.picture) == RED).all(axis=-1).any()


def test_frames_in_which_it_is_hidden_do_not_count():
    assert share(TOP, BOTTOM, visible=np.array([True, False])).share == pytest.approx(0.25, abs=0.002)
    assert share(TOP, visible=np.array([False])).share == 0.0


def test_the_discs_show_their_own_half():
    pixels = np.asarray(share(TOP).picture).astype(int)
    red = np.abs(pixels - RED).sum(axis=-1) < 3
    left, right = red[:, : pixels.shape[1] // 2].sum(), red[:, pixels.shape[1] // 2 :].sum()
    # Of the upper half half is seen, of the lower one nothing.
    assert left == pytest.approx(right / 2, rel=0.05)


def test_a_camera_is_drawn_where_it_is():
    """Towards +x on the left disc is right of its middle."""
    pixels = np.asarray(share((1.0, 0.0, 0.5)).picture).sum(axis=-1)
    rows, columns = np.nonzero(pixels[:310] < 70)
    assert columns.mean() > 14 + 150 + 50 and columns.mean() < 14 + 300
    assert rows.mean() == pytest.approx(14 + 150, abs=2)

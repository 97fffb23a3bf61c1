"""Frames in which a segmentation lost the object."""

from __future__ import annotations

import numpy as np
import pytest
from filmed_egg import film
from turning_object import K, rotation_errors, turning_object

from bigs.motion.given_poses import GivenPoses
from bigs.motion.masks import short_gaps, without_gaps
from bigs.motion.tracker import track
from bigs.motion.tracker_config import TrackerConfig


def moving_square(lost: tuple[int, ...]) -> np.ndarray:
    masks = np.zeros((10, 12, 30), dtype=bool)
    for t in range(10):
        masks[t, 2:10, 2 * t : 2 * t + 8] = t not in lost
    return masks


@pytest.mark.parametrize("lost", [(4,), (4, 5), (4, 5, 6), (2, 6)])
def test_a_short_gap_shows_what_both_sides_share(lost: tuple[int, ...]) -> None:
    masks = moving_square(lost)
    filled = without_gaps(masks)
    assert not masks[list(lost)].any()  # the given ones stay
    whole = moving_square(())
    for t in range(10):
        if t not in lost:
            assert (filled[t] == masks[t]).all()
        else:
            before = max(s for s in range(t) if s not in lost)
            after = min(s for s in range(t, 10) if s not in lost)
            assert (filled[t] == (whole[before] & whole[after])).all()
    assert filled[lost[0]].any() == (len(lost) < 3)  # in four frames the square moves by its own width


@pytest.mark.parametrize("lost", [(), (3, 4, 5, 6), (0, 1), (8, 9), tuple(range(10))])
def test_other_gaps_stay(lost: tuple[int, ...]) -> None:
    masks = moving_square(lost)
    assert (without_gaps(masks) == masks).all()


def test_gaps_lie_between_frames_that_show() -> None:
    shown = np.array([0, 1, 0, 0, 0, 1, 1, 0, 1, 0, 0, 0, 0, 1, 0], dtype=bool)
    assert short_gaps(shown) == [(1, 5), (6, 8)]
    assert short_gaps(shown[:1]) == [] == short_gaps(shown[:0])


def test_tracks_go_on_through_a_frame_without_a_mask() -> None:
    egg = turning_object(frames=12, points=300)
    images, masks = film(egg)
    masks[[5, 8]] = False
    given = GivenPoses(egg.rotations, egg.transl, np.ones(12))
    found = track(images, masks, K, given, TrackerConfig())
    assert found.observations.min() > 30
    assert rotation_errors(found.rotations, egg.rotations).max() < 0.5

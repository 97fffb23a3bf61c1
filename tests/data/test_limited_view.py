"""The limited view shows less of the object than any other choice around one of its frames."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from bigs.data.base import Clip
from bigs.data.limited_view import limited_frames, object_directions


def around(degrees: np.ndarray) -> np.ndarray:
    angles = np.radians(degrees)
    return np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)


def test_the_cap_is_the_smallest_about_a_frame() -> None:
    directions = np.random.default_rng(0).normal(size=(12, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    frames, reach = limited_frames(directions)
    assert len(frames) == 3 and (np.diff(frames) > 0).all()
    # Every set of three frames, each with the best of its own frames as its middle.
    best = min(
        min(max(np.arccos(np.clip(directions[m] @ directions[t], -1, 1)) for t in chosen) for m in chosen)
        for chosen in itertools.combinations(range(12), 3)
    )
    assert reach == pytest.approx(best)


def test_an_even_turn_leaves_a_quarter_of_it() -> None:
    frames, reach = limited_frames(around(np.arange(0, 360, 6)))
    assert len(frames) == 15
    assert np.degrees(reach) == pytest.approx(42.0)


def test_a_share_is_rounded_up() -> None:
    assert len(limited_frames(around(np.arange(5.0)))[0]) == 2
    assert len(limited_frames(around(np.arange(5.0)), share=1.0)[0]) == 5


def test_directions_are_seen_from_the_object(tiny: Clip) -> None:
    directions = object_directions(tiny)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    assert tiny.object is not None
    # Walking from the object's middle along the direction, in its own axes, leads to the camera.
    for t in (0, len(tiny) - 1):
        to_cam = tiny.cam_from_world[t]
        middle = tiny.object.points_world()[t].mean(axis=0)
        step = tiny.object.rotations[t] @ directions[t]
        far = to_cam[:3, :3] @ (middle + 0.1 * step) + to_cam[:3, 3]
        near = to_cam[:3, :3] @ middle + to_cam[:3, 3]
        np.testing.assert_allclose(np.linalg.norm(near) - np.linalg.norm(far), 0.1, atol=1e-9)

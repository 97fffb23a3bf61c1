"""Estimates that cannot be are refused in one sentence; single faults are taken out and told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.data.oddities.plausible import plausible
from bigs.hand import HandModel
from bigs.types import Side

BEHIND = np.array([0.0, 0.0, 5.0])  # the clip's world has z backwards


@pytest.fixture
def checked(tiny: Clip, both_hands: dict[Side, HandModel]) -> Callable[..., Clip]:
    """The tiny clip with some fields of its object, its right hand or itself replaced, and checked."""
    wrists = {side: np.zeros(3) for side in both_hands}

    def check(obj: dict[str, Any] | None = None, hand: dict[str, Any] | None = None, **clip: Any) -> Clip:
        assert tiny.object is not None
        hands = dict(tiny.hands) | {"right": replace(tiny.hands["right"], **(hand or {}))}
        changed = replace(tiny, object=replace(tiny.object, **(obj or {})), hands=hands, **clip)
        return plausible(changed, wrists)

    return check


def scaled(clip: Clip, factor: float) -> dict[str, Any]:
    assert clip.object is not None
    return {"metric_from_canon": np.diag([factor, factor, factor, 1.0]) @ clip.object.metric_from_canon}


def test_an_honest_clip_is_left_as_it_is(checked: Callable[..., Clip], tiny: Clip) -> None:
    clip = checked()
    assert clip.notes == ()
    assert clip.object is not None and tiny.object is not None
    assert clip.object.points is tiny.object.points and clip.object.transl is tiny.object.transl
    assert clip.hands["right"].transl is tiny.hands["right"].transl


@pytest.mark.parametrize("factor", [1e-30, 1e-2, 20.0, 1e6])
def test_an_object_of_an_impossible_size(checked: Callable[..., Clip], tiny: Clip, factor: float) -> None:
    with pytest.raises(InputError, match=r"object: expected points .* found"):
        checked(scaled(tiny, factor))


def test_an_object_of_an_odd_size_is_told(checked: Callable[..., Clip], tiny: Clip) -> None:
    (note,) = checked(scaled(tiny, 3.0)).notes
    assert note.startswith("object: its points may be of the wrong size")


@pytest.mark.parametrize("count", [1, 4])
def test_an_object_of_hardly_any_points(checked: Callable[..., Clip], tiny: Clip, count: int) -> None:
    assert tiny.object is not None
    points = np.vstack([np.zeros(3), np.eye(3)])[:count] * np.ptp(tiny.object.points, axis=0)
    with pytest.raises(InputError, match=r"object: expected .*points"):
        checked({"points": points, "colors": None})


def test_a_stray_point_is_left_out(checked: Callable[..., Clip], tiny: Clip) -> None:
    assert tiny.object is not None
    stray = np.vstack([tiny.object.points, [[1e6, 0.0, 0.0]]])
    clip = checked({"points": stray, "colors": np.zeros((len(stray), 3))})
    assert clip.object is not None and clip.object.colors is not None
    np.testing.assert_array_equal(clip.object.points, tiny.object.points)
    assert len(clip.object.colors) == len(tiny.object.points)
    assert f"1 of {len(stray)} points lie up to" in clip.notes[0]


@pytest.mark.parametrize("shift", [BEHIND, -1e4 * BEHIND], ids=["behind", "far"])
def test_misplaced_frames_are_filled(checked: Callable[..., Clip], tiny: Clip, shift: np.ndarray) -> None:
    assert tiny.object is not None
    hand, thing = tiny.hands["right"].transl.copy(), tiny.object.transl.copy()
    hand[[3, 4]] += shift
    thing[0] += shift
    clip = checked({"transl": thing}, {"transl": hand})
    track, obj = clip.hands["right"], clip.object
    assert obj is not None
    assert np.flatnonzero(~track.valid).tolist() == [3, 4] and np.flatnonzero(~obj.valid).tolist() == [0]
    np.testing.assert_allclose(track.transl[3], (2 * hand[2] + hand[5]) / 3)
    np.testing.assert_allclose(obj.transl[0], thing[1])
    np.testing.assert_allclose(obj.rotations[0], tiny.object.rotations[1], atol=1e-12)
    assert any("right hand" in note and "2 frames (3, 4)" in note for note in clip.notes)
    assert any("object" in note and "frame 0" in note for note in clip.notes)


def test_nothing_left_before_the_camera(checked: Callable[..., Clip], tiny: Clip) -> None:
    with pytest.raises(InputError, match=r"right hand: expected .* found it behind the camera in 12 frames"):
        checked(hand={"transl": tiny.hands["right"].transl + BEHIND})
    assert tiny.object is not None
    with pytest.raises(InputError, match=r"object: expected .* found it more than 100 m away"):
        checked({"transl": tiny.object.transl - 1e5 * BEHIND})


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("hand_pose", np.full((12, 15, 3), 1e14), "turns"),
        ("global_orient", np.full((12, 3), 200.0), "turns"),
        ("betas", np.full(10, 1e3), "shape parameters"),
    ],
)
def test_a_hand_that_cannot_be(checked: Callable[..., Clip], field: str, value: Any, words: str) -> None:
    with pytest.raises(InputError, match=rf"right hand: expected {words}.*found"):
        checked(hand={field: value})


@pytest.mark.parametrize("length", [0.0, 1e-9, 1e9])
def test_a_shift_that_the_challenge_cannot_hold(checked: Callable[..., Clip], length: float) -> None:
    with pytest.raises(InputError, match="normalize_shift"):
        checked(normalize_shift=np.array([0.0, 0.0, length]))

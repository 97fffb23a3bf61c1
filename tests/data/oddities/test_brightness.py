"""Dark and pale pictures are shown as usual; others stay as they are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toy_clips import painted_clip

from bigs.data.base import Clip
from bigs.data.oddities.brightness import brightened
from bigs.data.oddities.exposure import with_one_exposure

FRAMES, HEIGHT, WIDTH = 4, 40, 60


def filmed(
    folder: Path,
    brightness: float,
    *,
    black: float = 0.0,
    subject: float = 0.9,
    room: float = 0.6,
    size: int = 15,
    darkest: float = 0.0,
) -> Clip:
    """A hand and an object whose brightest channel is `subject` before a room, all times `brightness`."""
    images = np.random.default_rng(0).uniform(darkest, room, (FRAMES, HEIGHT, WIDTH, 3))
    labels = np.zeros((FRAMES, HEIGHT, WIDTH), dtype=np.uint8)
    labels[:, 12 : 12 + size, 25 - size : 25], labels[:, 12 : 12 + size, 25 : 25 + size] = 150, 50
    images[labels > 0] *= 0.5
    images[labels > 0, 0] = subject
    files = 255.0 * (black + brightness * images)
    clip = painted_clip(folder, files.round().astype(np.uint8), labels)
    assert clip.object is not None
    colors = black + np.array([[0.9, 0.4, 0.2], [0.1, 0.2, 0.3]]) * brightness
    return replace(clip, object=replace(clip.object, points=np.eye(3)[:2], colors=colors))


@pytest.mark.parametrize(
    ("black", "brightness"), [(0.0, 0.7), (0.0, 0.4), (0.0, 0.15), (0.2, 0.6), (0.45, 0.4), (0.2, 0.15)]
)
def test_dark_and_pale_pictures_look_as_usual(tmp_path: Path, black: float, brightness: float) -> None:
    usual, worse = filmed(tmp_path / "usual", 1.0), filmed(tmp_path / "worse", brightness, black=black)
    shown = brightened(worse)
    assert shown.black == pytest.approx(black, abs=0.01)
    # What is darkest in a pale clip need not be black.
    inexact = 0.02 if black == 0.0 else 0.05
    assert shown.brightness == pytest.approx(brightness, rel=inexact)
    steps = 1.0 / brightness  # of the files' whole numbers
    for t in range(FRAMES):
        for image in (shown.image(t), shown.image_as_taken(t)):
            assert np.abs(image.astype(float) - usual.image(t)).max() < 0.6 * steps + inexact * 255
    assert shown.object is not None and usual.object is not None
    np.testing.assert_allclose(shown.object.colors, usual.object.colors, atol=inexact)


def test_frames_of_another_exposure_have_another_black(tmp_path: Path) -> None:
    clip = filmed(tmp_path, 0.5, black=0.2)
    files = clip.image(0) / 255.0
    clip = replace(clip, black=0.2, brightness=0.5)
    brighter = np.tile([1.1, 1.2, 1.0], (FRAMES, 1))
    expected = 255.0 * (files / brighter[0] - 0.2) / 0.5
    np.testing.assert_allclose(replace(clip, gains=brighter).image(0), expected.clip(0, 255), atol=0.51)
    assert np.abs(replace(clip, brightness=1.0).image(0) - 255.0 * (files - 0.2)).max() < 0.51


@pytest.mark.parametrize(
    ("brightness", "subject", "room", "size", "darkest"),
    [
        (1.0, 0.9, 0.6, 15, 0.0),
        (1.0, 0.2, 1.0, 15, 0.0),
        (1.0, 0.9, 0.11, 2, 0.0),
        (1.0, 1.0, 1.0, 15, 0.25),
        (0.01, 0.9, 0.6, 15, 0.0),
    ],
    ids=[
        "good light",
        "black things in it",
        "small bright things in the dark",
        "nothing is black",
        "nothing shows",
    ],
)
def test_others_stay_as_they_are(
    tmp_path: Path, brightness: float, subject: float, room: float, size: int, darkest: float
) -> None:
    clip = filmed(tmp_path, brightness, subject=subject, room=room, size=size, darkest=darkest)
    assert brightened(clip) is clip


@pytest.mark.parametrize(("black", "brightness"), [(0.0, 0.15), (0.35, 0.4)], ids=["dark", "pale"])
def test_exposure_is_found_in_the_dark_and_through_haze(
    tmp_path: Path, black: float, brightness: float
) -> None:
    """Its levels count for pictures as bright as usual; files stay as dark and as pale as they are."""
    rng = np.random.default_rng(1)
    room = np.kron(rng.uniform(0.2, 0.5, (10, 15, 1)), np.ones((8, 8, 3)))
    gains = np.array([1.0, 1.0, 0.8, 1.2, 1.0])
    labels = np.zeros((len(gains), 80, 120), dtype=np.uint8)
    labels[:, 20:50, 20:50] = 150
    images = black + brightness * np.where(labels[..., None] > 0, 0.8, room)
    images *= gains[:, None, None, None]
    clip = with_one_exposure(painted_clip(tmp_path, (255.0 * images).round().astype(np.uint8), labels))
    assert clip.gains is not None and clip.brightness == 1.0
    np.testing.assert_allclose(clip.gains, np.repeat(gains[:, None], 3, axis=1), atol=0.06)
    shown = brightened(clip)
    assert np.ptp([shown.image(t)[60:].mean() for t in range(len(gains))]) < 6.0
    if black == 0.0:
        assert shown.image(0)[60:].mean() > 80.0 > 20.0 > clip.image(0)[60:].mean()
    else:
        assert shown.image(0)[60:].std() > 1.5 * clip.image(0)[60:].std()

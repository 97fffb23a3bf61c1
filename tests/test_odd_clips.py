"""Clips in which something is not to be seen, or estimated where it cannot be: they end in finite results."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import load_file
from short_plans import short

from bigs.commands.run.reconstruct import reconstruct
from bigs.train.plan.presets import SMOKE
from bigs.types import MASK_VALUES
from bigs.unpickle import load_npy

pytestmark = pytest.mark.slow


class OddClip:
    """A copy of the tiny clip that can be changed."""

    def __init__(self, folder: Path) -> None:
        self.build = folder / "build"

    def paint(self, change: Callable[[int, np.ndarray], None]) -> None:
        """Change the masks: frame and labels [H, W]."""
        for t, file in enumerate(sorted((self.build / "mask").iterdir())):
            labels = np.asarray(Image.open(file)).copy()
            change(t, labels)
            Image.fromarray(labels).save(file)

    def erase(self, *entities: str, frames: range = range(12)) -> None:
        values = [MASK_VALUES[entity] for entity in entities]

        def change(t: int, labels: np.ndarray) -> None:
            labels[np.isin(labels, values) & (t in frames)] = 0

        self.paint(change)

    def move(self, entity: str, by: tuple[float, float, float], frames: slice = slice(None)) -> None:
        """Shift an estimate, in the clip's units."""
        data: dict[str, Any] = load_npy(self.build / "data.npy")
        track = data["entities"][entity]
        if entity == "object":
            track["object_poses"][frames, 3:6] += np.array(by)
        else:
            track["hand_trans"][frames] += np.array(by)
        np.save(self.build / "data.npy", np.array(data, dtype=np.object_))


def nothing_is_labelled(clip: OddClip) -> None:
    clip.erase("right", "left", "object")


def one_frame_is_labelled(clip: OddClip) -> None:
    clip.erase("right", "left", "object", frames=range(1, 12))


def a_hand_is_never_seen(clip: OddClip) -> None:
    clip.erase("right")


def the_object_is_all_there_is(clip: OddClip) -> None:
    clip.paint(lambda t, labels: labels.fill(MASK_VALUES["object"]))


def a_hand_leaves_the_image(clip: OddClip) -> None:
    clip.erase("right", frames=range(6, 12))
    clip.move("right", (3.0, 0.0, 0.0), slice(6, None))


def a_hand_is_far_outside(clip: OddClip) -> None:
    clip.erase("right")
    clip.move("right", (30.0, 0.0, 0.0))


def a_hand_is_far_away(clip: OddClip) -> None:
    clip.move("right", (0.0, 0.0, -30.0))


def both_are_behind_the_camera_once(clip: OddClip) -> None:
    # The file's z points backwards.
    clip.move("right", (0.0, 0.0, 30.0), slice(7, 9))
    clip.move("object", (0.0, 0.0, 30.0), slice(4, 5))


@pytest.mark.parametrize(
    "make_odd",
    [
        nothing_is_labelled,
        one_frame_is_labelled,
        a_hand_is_never_seen,
        the_object_is_all_there_is,
        a_hand_leaves_the_image,
        a_hand_is_far_outside,
        a_hand_is_far_away,
        both_are_behind_the_camera_once,
    ],
)
def test_it_ends_well(tiny_clip: Path, tmp_path: Path, make_odd: Callable[[OddClip], None]) -> None:
    make_odd(OddClip(Path(shutil.copytree(tiny_clip, tmp_path / "clip"))))
    outcome = reconstruct(tmp_path / "clip", tmp_path / "run", short(SMOKE, image_size=40))
    written = load_file(tmp_path / "run" / "scene.safetensors")
    assert all(np.isfinite(values).all() for values in written.values() if values.dtype.kind == "f")
    assert {key.split(".")[0] for key in written} >= {"right", "left", "object"}
    assert (tmp_path / "run" / "report.html").exists()
    assert outcome.report.retreats == []  # nothing became infinite on the way
    told = any("no frame shows the object" in line for line in outcome.report.skipped)
    assert told == (make_odd is nothing_is_labelled)
    if make_odd is both_are_behind_the_camera_once:
        assert "object: behind the camera in frame 4" in outcome.report.facts["clip"]
        assert "right hand: behind the camera in 2 frames (7, 8)" in outcome.report.facts["clip"]

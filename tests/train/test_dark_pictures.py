"""A clip in the dark is fitted like the same in good light, and its result is as dark as its pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from short_plans import short

from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.models.playback import Playback, record
from bigs.train.fit import FitReport, fit
from bigs.train.plan.presets import SMOKE
from bigs.types import Side

BRIGHTNESS = 0.25
PLAN = short(replace(SMOKE, stages=tuple(SMOKE.stages[i] for i in (5, 9, 10))), steps=3)


@pytest.fixture(scope="module")
def pair(
    tiny: Clip, both_hands: dict[Side, HandModel], tmp_path_factory: pytest.TempPathFactory
) -> list[tuple[Playback, FitReport]]:
    """Recordings in good light and in the dark."""
    folder = tmp_path_factory.mktemp("dark")
    paths = tuple(folder / path.name for path in tiny.image_paths)
    for path, source in zip(paths, tiny.image_paths, strict=True):
        image = BRIGHTNESS * np.asarray(Image.open(source).convert("RGB"), dtype=np.float64)
        Image.fromarray(image.round().astype(np.uint8)).save(path)
    assert tiny.object is not None and tiny.object.colors is not None
    dim = replace(
        tiny, image_paths=paths, object=replace(tiny.object, colors=BRIGHTNESS * tiny.object.colors)
    )
    runs = []
    for clip in (tiny, dim):
        scene, report = fit(clip, both_hands, PLAN)
        runs.append((record(scene, clip.name, clip.frame_names, clip.normalize_shift), report))
    return runs


def test_poses_are_those_of_good_light(pair: list[tuple[Playback, FitReport]]) -> None:
    lit, dark = (recording.trajectory() for recording, _ in pair)
    for side in lit.joints:
        # Whole numbers of dark files are coarse.
        assert np.abs(lit.joints[side] - dark.joints[side]).max() < 1e-3


def test_colours_are_those_of_the_pictures(pair: list[tuple[Playback, FitReport]]) -> None:
    lit, dark = (recording.gaussians([0]).colors for recording, _ in pair)
    ratio = dark.mean((0, 1)) / lit.mean((0, 1))
    torch.testing.assert_close(ratio, torch.full_like(ratio, BRIGHTNESS), rtol=0.05, atol=0.0)


def test_the_report_says_so(pair: list[tuple[Playback, FitReport]]) -> None:
    (_, lit), (_, dark) = pair
    assert "pictures" not in lit.facts
    assert dark.facts["pictures"].startswith("dark; fitted as if ")

"""A dark or pale clip is fitted like the same in good light, and its result looks like its pictures."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from PIL import Image
from short_plans import short

from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.models.playback import Playback, record
from bigs.train.fit import fit
from bigs.train.plan.presets import SMOKE
from bigs.types import Side

PLAN = short(replace(SMOKE, stages=tuple(SMOKE.stages[i] for i in (5, 9, 10))), steps=3)


class Pair(NamedTuple):
    """Recordings in good light and as black + brightness times that."""

    black: float
    brightness: float
    lit: Playback
    worse: Playback
    facts: tuple[dict[str, str], dict[str, str]]


@pytest.fixture(scope="module", params=[(0.0, 0.25), (0.3, 0.45)], ids=["dark", "pale"])
def pair(
    request: pytest.FixtureRequest,
    tiny: Clip,
    both_hands: dict[Side, HandModel],
    tmp_path_factory: pytest.TempPathFactory,
) -> Pair:
    black, brightness = request.param
    folder = tmp_path_factory.mktemp("worse")
    paths = tuple(folder / path.name for path in tiny.image_paths)
    for path, source in zip(paths, tiny.image_paths, strict=True):
        image = 255.0 * black + brightness * np.asarray(Image.open(source).convert("RGB"), dtype=np.float64)
        Image.fromarray(image.round().astype(np.uint8)).save(path)
    assert tiny.object is not None and tiny.object.colors is not None
    seen = replace(tiny.object, colors=black + brightness * tiny.object.colors)
    runs = [fit(clip, both_hands, PLAN) for clip in (tiny, replace(tiny, image_paths=paths, object=seen))]
    lit, worse = (record(scene, tiny.name, tiny.frame_names, tiny.normalize_shift) for scene, _ in runs)
    return Pair(black, brightness, lit, worse, (runs[0][1].facts, runs[1][1].facts))


def test_poses_are_those_of_good_light(pair: Pair) -> None:
    lit, worse = pair.lit.trajectory(), pair.worse.trajectory()
    for side in lit.joints:
        # Whole numbers of such files are coarse.
        assert np.abs(lit.joints[side] - worse.joints[side]).max() < 1e-3


def test_colours_are_those_of_the_pictures(pair: Pair) -> None:
    lit, worse = (recording.gaussians([0]).colors for recording in (pair.lit, pair.worse))
    expected = pair.black + pair.brightness * lit.mean((0, 1))
    torch.testing.assert_close(worse.mean((0, 1)), expected, rtol=0.05, atol=0.0)


def test_the_report_says_so(pair: Pair) -> None:
    lit, worse = pair.facts
    assert "pictures" not in lit
    words = "dark; fitted as if " if pair.black == 0.0 else "pale; fitted with "
    assert worse["pictures"].startswith(words)

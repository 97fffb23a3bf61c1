"""The held cube and pictures of noise, on which most stages are tried, and a clip of a bottle."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_once import MadeOnce
from toy_stages import held_cube, random_evidence

from bigs.data.base import Clip
from bigs.data.formats.hold import load_hold
from bigs.data.ground_truth import load_ground_truth
from bigs.data.synthetic import make_clip
from bigs.hand import HandModel
from bigs.models.scene import Scene
from bigs.train.loop.step import Evidence
from bigs.types import HandObjectTrajectory, Side


@pytest.fixture
def scene(both_hands: dict[Side, HandModel]) -> Scene:
    return held_cube(both_hands)


@pytest.fixture
def evidence(scene: Scene) -> Evidence:
    return random_evidence(scene)


@pytest.fixture(scope="session")
def whole_bottle(made_once: MadeOnce, both_hands: dict[Side, HandModel]) -> tuple[Clip, HandObjectTrajectory]:
    """A whole turn of a bottle in 36 small frames, and the truth."""

    def make(folder: Path) -> None:
        make_clip(folder / "clip", hand_models=both_hands, frames=36, width=240, height=180, seed=2)

    clip = made_once("bottle", make)[0] / "clip"
    return load_hold(clip), load_ground_truth(clip)

"""The held cube and pictures of noise, on which most stages are tried."""

from __future__ import annotations

import pytest
from toy_stages import held_cube, random_evidence

from bigs.hand import HandModel
from bigs.models.scene import Scene
from bigs.train.loop.step import Evidence
from bigs.types import Side


@pytest.fixture
def scene(both_hands: dict[Side, HandModel]) -> Scene:
    return held_cube(both_hands)


@pytest.fixture
def evidence(scene: Scene) -> Evidence:
    return random_evidence(scene)

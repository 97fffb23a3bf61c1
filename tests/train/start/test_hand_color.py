"""Hands start in the colour that pictures show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_clips import painted_clip

from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.models.hand_splats import HandSplats, HandSplatsConfig
from bigs.train.start.hand_color import hand_color
from bigs.types import Side


def painted(folder: Path, skin: tuple[int, int, int], hand: bool = True) -> Clip:
    images = np.full((3, 20, 30, 3), 200, dtype=np.uint8)
    labels = np.zeros((3, 20, 30), dtype=np.uint8)
    labels[:, 2:10, 2:10] = 50
    if hand:
        labels[:, 12:18, 5:20] = 250
        images[labels == 250] = skin
        images[:, 12, 5:8] = 255  # a highlight
    return painted_clip(folder, images, labels)


@pytest.mark.parametrize("skin", [(70, 45, 35), (220, 180, 160), (30, 60, 190)])
def test_it_is_that_of_the_labelled_pixels(tmp_path: Path, skin: tuple[int, int, int]) -> None:
    found = hand_color(painted(tmp_path, skin))
    assert found == pytest.approx([value / 255.0 for value in skin])


def test_it_is_one_that_a_gaussian_can_have(tmp_path: Path) -> None:
    found = hand_color(painted(tmp_path, (0, 255, 0)))
    assert found is not None and all(0.0 < value < 1.0 for value in found)


def test_where_no_hand_is_seen_nothing_is_known(tmp_path: Path) -> None:
    clip = painted(tmp_path, (0, 0, 0), hand=False)
    assert hand_color(clip) is None


def test_the_configuration_comes_first(both_hands: dict[Side, HandModel]) -> None:
    def start(config: HandSplatsConfig, color: tuple[float, float, float] | None) -> list[float]:
        return torch.sigmoid(HandSplats(both_hands["right"], config, color).color).tolist()

    config = HandSplatsConfig(subdivisions=0)
    seen, chosen = (0.2, 0.3, 0.4), (0.6, 0.5, 0.4)
    assert start(config, seen) == pytest.approx(seen)
    assert start(replace(config, color=chosen), seen) == pytest.approx(chosen)
    assert start(config, None) == start(config, None) != pytest.approx(seen)

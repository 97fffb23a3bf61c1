"""SIFT features of an object's pixels: on as many threads as bigs may take, and the same for any number."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from bigs.motion import features
from bigs.motion.features import FeatureConfig, extract_features


@pytest.fixture
def speckled() -> tuple[list[np.ndarray], np.ndarray]:
    """Four pictures of coarse noise, of which an object covers the middle."""
    generator = np.random.default_rng(0)
    coarse = generator.integers(0, 255, (4, 15, 20, 3), dtype=np.uint8)
    images = list(coarse.repeat(8, axis=1).repeat(8, axis=2))
    masks = np.zeros((4, 120, 160), dtype=bool)
    masks[:, 20:100, 30:130] = True
    return images, masks


@pytest.mark.parametrize("threads", [1, 2])
def test_colmap_takes_no_more_threads_than_bigs(
    speckled: tuple[list[np.ndarray], np.ndarray], threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    extract, taken = features.pycolmap.extract_features, []

    def watched(*args: Any, **options: Any) -> None:
        taken.append(options["extraction_options"].num_threads)
        extract(*args, **options)

    monkeypatch.setattr(features.pycolmap, "extract_features", watched)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        extract_features(*speckled, FeatureConfig())
    finally:
        torch.set_num_threads(before)
    assert taken == [threads]


def test_features_lie_on_the_object_and_do_not_depend_on_threads(
    speckled: tuple[list[np.ndarray], np.ndarray],
) -> None:
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(extract_features(*speckled, FeatureConfig()))
    finally:
        torch.set_num_threads(before)
    for one, two in zip(*found, strict=True):
        assert len(one.pixels) > 20
        column, row = np.floor(one.pixels).astype(int).T
        assert speckled[1][0][row, column].all()
        for a, b in zip(one, two, strict=True):
            assert np.array_equal(a, b)

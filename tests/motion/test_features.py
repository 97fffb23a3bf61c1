"""SIFT features of an object's pixels and COLMAP's work on them, on as many threads as bigs may take."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

from bigs.colmap import pycolmap
from bigs.motion.features import FeatureConfig, FrameFeatures, extract_features
from bigs.motion.models import MappingConfig, map_features, match_features
from bigs.threads import limit_threads

SIZE = (160, 120)
K = np.array([[150.0, 0.0, 80.0], [0.0, 150.0, 60.0], [0.0, 0.0, 1.0]])


@pytest.fixture
def speckled() -> tuple[list[np.ndarray], np.ndarray]:
    """A picture of coarse noise four times, moved to the right, of which an object covers the middle."""
    generator = np.random.default_rng(0)
    coarse = generator.integers(0, 255, (15, 20, 3), dtype=np.uint8)
    picture = coarse.repeat(8, axis=0).repeat(8, axis=1)
    masks = np.zeros((4, 120, 160), dtype=bool)
    masks[:, 20:100, 30:130] = True
    return [np.roll(picture, 3 * t, axis=1) for t in range(4)], masks


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """As many threads as bigs is limited to in the test."""
    before = torch.get_num_threads()
    monkeypatch.setenv("RAYON_NUM_THREADS", "1")  # put back afterwards
    limit_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def features_of(speckled: tuple[list[np.ndarray], np.ndarray]) -> list[FrameFeatures]:
    return extract_features(*speckled, FeatureConfig())


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How many threads each of COLMAP's functions was given."""
    given: dict[str, int] = {}

    def watch(name: str, option: str) -> None:
        function = getattr(pycolmap, name)

        def watched(*args: Any, **options: Any) -> Any:
            given[name] = options[option].num_threads
            return function(*args, **options)

        monkeypatch.setattr(pycolmap, name, watched)

    watch("extract_features", "extraction_options")
    watch("match_image_pairs", "matching_options")
    watch("match_sequential", "matching_options")
    watch("match_exhaustive", "matching_options")
    watch("incremental_mapping", "options")
    return given


def test_colmap_takes_no_more_threads_than_bigs(
    speckled: tuple[list[np.ndarray], np.ndarray], threads: int, taken: dict[str, int]
) -> None:
    features = features_of(speckled)
    matches = match_features(features, K, SIZE, [(0, 1), (1, 2)], MappingConfig())
    assert len(matches[0, 1]) > 10
    for pairs in ("sequential", "exhaustive"):
        map_features(features, K, SIZE, True, MappingConfig(pairs=pairs))
    assert len(taken) == 5
    assert set(taken.values()) == {threads}


def test_features_lie_on_the_object_and_do_not_depend_on_threads(
    speckled: tuple[list[np.ndarray], np.ndarray], threads: int
) -> None:
    found = features_of(speckled)
    limit_threads(3 - threads)
    for one, two in zip(found, features_of(speckled), strict=True):
        assert len(one.pixels) > 20
        column, row = np.floor(one.pixels).astype(int).T
        assert speckled[1][0][row, column].all()
        for a, b in zip(one, two, strict=True):
            assert np.array_equal(a, b)

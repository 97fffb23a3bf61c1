"""Learned features with random weights: files, formats, and that matches reach COLMAP's verification."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from kornia.feature import DISK, LightGlue
from turning_object import K, turning_object

from bigs.checks import InputError
from bigs.motion.features import FeatureConfig
from bigs.motion.models import MappingConfig, frame_pairs, map_features
from bigs.preprocess.object.learned_features import (
    LearnedMatcher,
    extract_learned,
    load_matcher,
    match_learned,
)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Random weights, written as the networks' authors name them."""
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    torch.save({"extractor": DISK().state_dict()}, folder / "disk.pth")
    names = {}
    for name, value in LightGlue(None, input_dim=128, weights=None).state_dict().items():
        parts = name.split(".")
        if parts[0] == "transformers":
            parts = [parts[2], parts[1], *parts[3:]]
        names[".".join(parts)] = value
    torch.save(names, folder / "glue.pth")
    return folder / "disk.pth", folder / "glue.pth"


@pytest.fixture(scope="module")
def matcher(files: tuple[Path, Path]) -> LearnedMatcher:
    return load_matcher(*files)


def test_published_names_are_understood(files: tuple[Path, Path], matcher: LearnedMatcher) -> None:
    stored = torch.load(files[1], weights_only=True)
    name = next(name for name in stored if name.startswith("cross_attn.4.") and name.endswith("weight"))
    loaded = matcher.glue.state_dict()[f"transformers.4.cross_attn.{name.removeprefix('cross_attn.4.')}"]
    assert torch.equal(loaded, stored[name])


def test_features_lie_on_the_object_and_are_matched(matcher: LearnedMatcher) -> None:
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (60, 80, 3), dtype=np.uint8)] * 2
    masks = np.zeros((3, 60, 80), dtype=bool)
    masks[:2, 20:45, 30:60] = True
    config = FeatureConfig(upscale=1.0, max_features=60)
    found = extract_learned([*images, images[0]], masks, matcher, config)
    assert len(found[0].pixels) > 5 and len(found[2].pixels) == 0
    assert (found[0].pixels >= (30, 20)).all() and (found[0].pixels < (60, 45)).all()
    np.testing.assert_allclose(np.linalg.norm(found[0].descriptors, axis=1), 512.0, rtol=1e-4)
    np.testing.assert_allclose(found[0].pixels, found[1].pixels)
    matches = match_learned(found, frame_pairs(3, MappingConfig()), (80, 60), matcher)
    assert set(matches) == {(0, 1)} and matches[0, 1].shape[1] == 2


def test_matches_from_elsewhere_are_verified_and_mapped() -> None:
    egg = turning_object(frames=16, points=400)
    candidates = egg.matches()
    rng = np.random.default_rng(1)
    wrong = {
        pair: np.concatenate([matches, rng.integers(0, 80, (10, 2))]) for pair, matches in candidates.items()
    }
    mapping = map_features(egg.features, K, (480, 360), True, MappingConfig(), wrong)
    assert len(mapping.models[0].frames) == 16
    kept = {tuple(row) for row in mapping.matches[0, 1]}
    true = {tuple(row) for row in candidates[0, 1]}
    assert len(kept & true) > 0.9 * len(true) and len(kept - true) <= 3


def test_exhaustive_pairs_are_all_pairs() -> None:
    assert len(frame_pairs(30, MappingConfig(pairs="exhaustive"))) == 30 * 29 // 2
    assert max(b - a for a, b in frame_pairs(30, MappingConfig())) == 10


def test_other_files_are_refused_by_name(files: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"glue\.pth: expected the weights of DISK.*missing"):
        load_matcher(files[1], files[1])
    with pytest.raises(InputError, match=r"none\.pth: expected a file of weights, found no such file"):
        load_matcher(files[0], tmp_path / "none.pth")
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(InputError, match=r"text\.pth: expected weights that torch reads"):
        load_matcher(tmp_path / "text.pth", files[1])

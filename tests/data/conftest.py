"""Fixtures of the data tests: a tiny hand-made clip, hand models, and one synthetic clip for all."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_clip import FRAMES, HEIGHT, SHIFT, WIDTH, K, random_hand, random_object, small_masks

import bigs.data.decoded
from bigs.data.formats.hold import write_hold
from bigs.data.images import read_image, read_mask
from bigs.data.synthetic import make_clip
from bigs.hand import HandModel, load_hand_models
from bigs.types import Side
from bigs.unpickle import load_npy


@pytest.fixture
def write_small(tmp_path: Path) -> Callable[..., Path]:
    """Writes a random clip of 5 frames of 24 x 16; keywords replace what `write_hold` is given."""

    def write(**changes: Any) -> Path:
        rng = np.random.default_rng(7)
        arguments: dict[str, Any] = {
            "name": "small",
            "frame_names": [f"{100 + t:05d}.jpg" for t in range(FRAMES)],
            "images": rng.integers(0, 256, (FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8),
            "masks": small_masks(),
            "K": K,
            "normalize_shift": SHIFT,
            "hands": {"right": random_hand(rng), "left": random_hand(rng)},
            "object": random_object(rng),
        }
        write_hold(tmp_path / "small", **(arguments | changes))
        return tmp_path / "small"

    return write


@pytest.fixture
def edit_data(write_small: Callable[..., Path]) -> Callable[[Callable[[dict[str, Any]], None]], Path]:
    """Writes the small clip, lets a function change the dictionary in its data.npy, returns the folder."""

    def edit(change: Callable[[dict[str, Any]], None]) -> Path:
        folder = write_small(torch_norm_mat=False)
        file = folder / "build" / "data.npy"
        data = load_npy(file)
        change(data)
        np.save(file, np.array(data, dtype=np.object_))
        return folder

    return edit


@pytest.fixture(scope="session")
def hand_models() -> dict[Side, HandModel]:
    return load_hand_models(None)


@pytest.fixture(scope="session")
def synthetic_clip(tmp_path_factory: pytest.TempPathFactory, hand_models: dict[Side, HandModel]) -> Path:
    return make_clip(
        tmp_path_factory.mktemp("synthetic") / "box", hand_models=hand_models, object="box", frames=16, seed=3
    )


@pytest.fixture(params=["dev_mustard", "dev_drill", "dev_sugar"])
def shared_clip(request: pytest.FixtureRequest) -> Path:
    """A path-traced clip with ground truth, where the machine has them."""
    folder = os.environ.get("BIGS_CLIPS")
    if not folder:
        pytest.skip("BIGS_CLIPS is not set")
    return Path(folder) / request.param


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each file was decoded."""
    counted: Counter[str] = Counter()

    def image(path: Path, size: tuple[int, int]) -> np.ndarray:
        counted[path.parent.name + path.name] += 1
        return read_image(path, size)

    def mask(path: Path, size: tuple[int, int]) -> np.ndarray:
        counted[path.parent.name + path.name] += 1
        return read_mask(path, size)

    monkeypatch.setattr(bigs.data.decoded, "read_image", image)
    monkeypatch.setattr(bigs.data.decoded, "read_mask", mask)
    return counted

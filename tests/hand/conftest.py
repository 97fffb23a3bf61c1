"""A small hand in MANO's layout, and the model files that the environment names."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bigs.hand import HandModel, builtin_hand


def model_fields(hand: HandModel, rng: np.random.Generator | None = None) -> dict[str, Any]:
    """A hand under MANO's key names; with `rng` also random pose correctives and a mean pose."""
    parents = np.array([2**32 - 1, *hand.parents[1:]], dtype=np.int64)
    fields = {
        "v_template": hand.v_template.double().numpy(),
        "f": hand.faces.numpy().astype(np.uint32),
        "shapedirs": hand.shapedirs.double().numpy(),
        "posedirs": hand.posedirs.double().numpy(),
        "weights": hand.lbs_weights.double().numpy(),
        "J_regressor": hand.J_regressor.double().numpy(),
        "kintree_table": np.stack([parents, np.arange(16)]),
        "hands_mean": hand.hands_mean.double().numpy().ravel(),
        "tip_vertex_ids": hand.tip_vertex_ids.numpy(),
    }
    if rng is not None:
        fields["posedirs"] = 1e-3 * rng.standard_normal(fields["posedirs"].shape)
        fields["hands_mean"] = 0.2 * rng.standard_normal(45)
    return fields


@pytest.fixture(scope="session")
def right() -> HandModel:
    return builtin_hand("right").double()


@pytest.fixture
def fields(right: HandModel) -> dict[str, Any]:
    return model_fields(right, np.random.default_rng(3))


@pytest.fixture
def rich_right(fields: dict[str, Any]) -> HandModel:
    """A right hand with pose correctives and a mean pose, so that nothing is tested on zeros."""
    from bigs.hand.io import hand_model_from_arrays

    return hand_model_from_arrays(fields, "right", name="test").double()


@pytest.fixture(scope="session")
def hand_model_dir() -> Path:
    if "BIGS_HAND_MODEL" not in os.environ:
        pytest.skip("BIGS_HAND_MODEL does not name a folder of MANO-format files")
    return Path(os.environ["BIGS_HAND_MODEL"])


@pytest.fixture(scope="session")
def clips_dir() -> Path:
    if "BIGS_CLIPS" not in os.environ:
        pytest.skip("BIGS_CLIPS does not name a folder of clips")
    return Path(os.environ["BIGS_CLIPS"])


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)

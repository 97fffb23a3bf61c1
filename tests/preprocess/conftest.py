"""A small clip taken apart into what a user of `bigs preprocess` has: pictures, masks, keypoints."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from taken_apart import Given

from bigs.data.ground_truth import load_ground_truth
from bigs.data.hold import load_hold
from bigs.types import SIDES


@pytest.fixture(scope="session")
def given(tiny_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Given:
    """The tiny clip's pictures, masks, noisy keypoints and camera. Read it, never write into it."""
    folder = tmp_path_factory.mktemp("given")
    clip, truth = load_hold(tiny_clip), load_ground_truth(tiny_clip)
    shutil.copytree(tiny_clip / "build" / "image", folder / "pictures")
    shutil.copytree(tiny_clip / "build" / "mask", folder / "masks")
    rng = np.random.default_rng(0)
    rows: list[dict[str, list[list[float]]]] = []
    for t in range(len(clip)):
        row = {}
        for side in SIDES:
            pixels = truth.joints[side][t] @ clip.K.T
            points = pixels[:, :2] / pixels[:, 2:] + 0.7 * rng.standard_normal((21, 2))
            row[side] = np.column_stack([points, np.full(21, 0.9)]).tolist()
        rows.append(row)
    (folder / "keypoints.json").write_text(json.dumps({"order": "mano", "frames": rows}))
    numbers = tuple(f"{clip.K[i, j]:.6f}" for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Given(
        folder / "pictures", folder / "masks", folder / "keypoints.json", ("--K", *numbers), tiny_clip
    )

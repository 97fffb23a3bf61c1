"""A small clip taken apart into what a user of `bigs preprocess` has: pictures, masks, keypoints."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from taken_apart import Given
from torch import Tensor

from bigs.data.formats.hold import load_hold
from bigs.data.ground_truth import load_ground_truth
from bigs.preprocess.hands import tracks
from bigs.preprocess.hands.fit import HandFit, HandFitConfig, fit_rays
from bigs.preprocess.hands.skeleton import HandSkeleton
from bigs.types import SIDES


@pytest.fixture(scope="session", autouse=True)
def fitted_once() -> Iterator[None]:
    """The same keypoints are fitted once, however many tests take a clip through all steps."""
    known: dict[tuple[object, ...], HandFit] = {}

    def fit(
        skeleton: HandSkeleton, rays: Tensor, trust: Tensor, config: HandFitConfig, fps: float
    ) -> HandFit:
        arrays = (rays, trust, skeleton.rest_joints, skeleton.shape_moves)
        key = (config, fps, *(array.numpy().tobytes() for array in arrays))
        if key not in known:
            known[key] = fit_rays(skeleton, rays, trust, config, fps)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracks, "fit_rays", fit)
        yield


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

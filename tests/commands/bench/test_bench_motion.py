"""`bigs bench motion`: what is made worse, and what the table says of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Answer, assert_refused

import bigs.commands.bench.motion as bench_motion
from bigs.motion.given_poses import GivenPoses
from bigs.motion.tracker import TrackedMotion


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[np.ndarray, GivenPoses]]:
    """What trackers were asked, who say what they were given and that frame 0 is wrong."""
    seen = []

    def track(images: Any, masks: np.ndarray, K: np.ndarray, given: GivenPoses, config: Any) -> TrackedMotion:
        seen.append((masks, given))
        count = len(given.rotations)
        return TrackedMotion(
            given.rotations,
            given.transl,
            np.tile(np.eye(6) * 1e-4, (count, 1, 1)),
            np.full(count, 50),
            np.arange(count) == 0,
            np.zeros((7, 3)),
            np.zeros((7, 3), dtype=np.uint8),
            np.zeros((0, 2), dtype=int),
            0.02,
            np.full(3, 0.003),
            1.0,
            0.005,
        )

    monkeypatch.setattr(bench_motion, "track", track)
    return seen


def test_poses_and_masks_are_made_worse(
    tiny_clip: Path, tmp_path: Path, call: Callable[..., Answer], asked: list[tuple[np.ndarray, GivenPoses]]
) -> None:
    answer = call("bench", "motion", str(tiny_clip), "--out", str(tmp_path))
    assert answer.code == 0, answer.err
    plain, poses, masks, both = asked
    turned = np.abs(poses[1].rotations - plain[1].rotations).max((1, 2)) > 0.1
    assert turned.sum() == round(0.1 * len(turned))
    assert np.array_equal(poses[1].rotations, both[1].rotations)
    assert np.array_equal(poses[0], plain[0]) and np.array_equal(masks[0], both[0])
    areas = masks[0].sum((1, 2)) / plain[0].sum((1, 2)).clip(1)
    assert areas[0] < 1.0 < areas[1]
    runs = json.loads((tmp_path / "motion.json").read_text())["runs"]
    assert [run["variant"] for run in runs] == ["plain", "poses", "masks", "both"]
    assert runs[0]["tracked"] == runs[0]["given"]
    assert runs[1]["wrong"] == np.flatnonzero(turned).tolist()
    assert max(runs[1]["tracked"]) == pytest.approx(60.0, abs=6.0)
    assert "| 0 of 0, 1 more |" in (tmp_path / "motion.md").read_text()


def test_a_variant_that_is_not_there_is_refused(
    tiny_clip: Path, tmp_path: Path, call: Callable[..., Answer]
) -> None:
    answer = call("bench", "motion", str(tiny_clip), "--variants", "foggy", "--out", str(tmp_path / "o"))
    assert_refused(answer, "--variants", "foggy")

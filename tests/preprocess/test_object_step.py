"""The object step around structure from motion: report, focal length, when it is skipped, what it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from bigs.checks import InputError
from bigs.commands.preprocess import object_steps
from bigs.commands.preprocess.object_steps import object_step
from bigs.commands.preprocess.request import PreprocessRequest
from bigs.preprocess.artefacts import FrameSet, ObjectSfm, read_frame_set, read_object_sfm, write_frame_set
from bigs.preprocess.object.checks import REVERSED, SfmChecks
from bigs.preprocess.object.sfm import SfmReport

FRAMES = 5


def silent(text: str) -> None:
    pass


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    processed = tmp_path / "clip" / "processed"
    for folder in ("frames", "masks"):
        (processed / folder).mkdir(parents=True)
        for t in range(FRAMES):
            values = np.full((24, 32, 3) if folder == "frames" else (24, 32), 50, dtype=np.uint8)
            Image.fromarray(values).save(processed / folder / f"{t:04d}.png")
    K = np.array([[40.0, 0.0, 16.0], [0.0, 40.0, 12.0], [0.0, 0.0, 1.0]])
    names = tuple(f"{t}.jpg" for t in range(FRAMES))
    write_frame_set(processed, FrameSet(names, 30.0, 32, 24, K, "assumed", False), "digest")
    return tmp_path / "clip"


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Structure from motion that finds a fixed result; the list says how it was called."""
    calls: list[dict[str, Any]] = []

    def fake(images: Any, masks: Any, K: Any, config: Any, **rest: Any) -> tuple[ObjectSfm, SfmReport]:
        calls.append({"K": K, "pairs": config.mapping.pairs, **rest})
        points = np.random.default_rng(0).normal(size=(20, 3))
        sure = np.array([0.9, 0.9, 0.9, 0.0, 0.0])
        sfm = ObjectSfm(
            np.tile(np.eye(3), (FRAMES, 1, 1)),
            np.tile([0.0, 0.0, 9.0], (FRAMES, 1)),
            np.ones(FRAMES, dtype=bool),
            sure,
            points,
            np.zeros((20, 3), dtype=np.uint8),
            np.eye(4),
        )
        counts = np.full(FRAMES, 30)
        checks = SfmChecks(
            counts, np.zeros(FRAMES), np.zeros(FRAMES), np.ones(FRAMES), [[], [], [], [REVERSED], [REVERSED]]
        )
        model = np.zeros(FRAMES, dtype=int)
        return sfm, SfmReport(counts, counts, [list(range(FRAMES))], model, checks, 50.0, 1)

    monkeypatch.setattr(object_steps, "structure_from_motion", fake)
    return calls


def test_report_picture_and_estimated_focal_length(clip: Path, found: list[dict[str, Any]]) -> None:
    outcome = object_step(PreprocessRequest(clip), silent)
    processed = clip / "processed"
    assert outcome.state == "made" and "2 of them doubtful" in outcome.summary
    assert outcome.notes[0].startswith("frames 3-4: its mirror image")
    assert "focal length estimated as 50 pixels" in outcome.notes[1]
    assert outcome.picture is not None and outcome.picture.is_file()
    assert found[0]["known_focal"] is False
    frames = read_frame_set(processed)
    assert frames.K[0, 0] == frames.K[1, 1] == 50.0 and not frames.focal_known
    rows = json.loads((processed / "object_sfm.json").read_text())["frames"]
    assert [row["flags"] for row in rows] == [[], [], [], [REVERSED], [REVERSED]]
    assert len(read_object_sfm(processed / "object_sfm.npz", FRAMES).points) == 20


def test_it_is_skipped_until_something_changes(clip: Path, found: list[dict[str, Any]]) -> None:
    first = object_step(PreprocessRequest(clip), silent)
    again = object_step(PreprocessRequest(clip), silent)
    assert again.state == "up to date" and again.notes == first.notes and len(found) == 1
    Image.fromarray(np.zeros((24, 32), dtype=np.uint8)).save(clip / "processed" / "masks" / "0002.png")
    assert object_step(PreprocessRequest(clip), silent).state == "made"
    assert object_step(PreprocessRequest(clip, exhaustive=True), silent).state == "made"
    assert [call["pairs"] for call in found] == ["sequential", "sequential", "exhaustive"]


def test_one_weights_file_of_two_is_refused(clip: Path, found: list[dict[str, Any]]) -> None:
    with pytest.raises(InputError, match="found no --lightglue"):
        object_step(PreprocessRequest(clip, disk=clip / "disk.pth"), silent)
    assert not found

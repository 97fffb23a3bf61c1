"""`bigs bench preprocess`: variants of a clip, the object's errors, and the page."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import Answer, assert_refused
from scipy.spatial.transform import Rotation

from bigs.checks import InputError
from bigs.commands.bench import preprocess as bench_preprocess
from bigs.commands.bench.preprocess import PreprocessPlan, object_errors
from bigs.commands.bench.variants import (
    VARIANTS,
    KeypointNoise,
    simulated_keypoints,
    truth_of,
    write_variant,
)
from bigs.commands.preprocess.request import PreprocessRequest, StepOutcome
from bigs.data.formats.hold import load_hold
from bigs.data.ground_truth import load_ground_truth
from bigs.data.images import read_image, read_mask
from bigs.preprocess.artefacts import Alignment
from bigs.types import MASK_VALUES

K = np.array([[400.0, 0.0, 160.0], [0.0, 400.0, 120.0], [0.0, 0.0, 1.0]])


def test_errors_are_those_after_one_similarity() -> None:
    rng = np.random.default_rng(0)
    true = Rotation.from_rotvec(np.radians(5.0 * np.arange(30))[:, None] * (0, 1, 0.2)).as_matrix()
    transl = rng.normal(0.0, 0.05, (30, 3)) + np.array([0, 0, 0.7])
    turn = Rotation.random(random_state=rng).as_matrix()
    middle = np.array([0.03, -0.02, 0.05])
    # The same motion in a turned, shifted frame that is 8 % too large ...
    found = true @ turn.T
    place = 1.08 * (transl + true @ middle)
    # ... but for the last five frames, which are turned by 20 degrees.
    found[25:] = Rotation.from_rotvec([0, np.radians(20.0), 0]).as_matrix() @ found[25:]
    errors = object_errors(Alignment(1.0, found, place, np.ones(30, bool), {}), true, transl)
    assert errors.degrees[:25].max() < 0.5
    assert errors.degrees[25:] == pytest.approx(20.0, abs=0.5)
    assert np.flatnonzero(errors.wrong()).tolist() == list(range(25, 30))
    assert errors.size == pytest.approx(1.08, abs=0.01)
    assert np.median(errors.millimetres) < 1.0


def test_every_variant_of_a_clip_can_be_written(tiny_clip: Path, tmp_path: Path) -> None:
    clip, truth = load_hold(tiny_clip), load_ground_truth(tiny_clip)
    for name, variant in VARIANTS.items():
        given = write_variant(tmp_path / name, clip, truth, variant)
        count = len(list(given.pictures.iterdir()))
        assert count == len(given.frames) == len(list(given.masks.iterdir()))
        rows = json.loads(given.keypoints.read_text())["frames"]
        assert len(rows) == count and all(set(row) <= set(variant.hands) for row in rows)
        shown = truth_of(truth, given)
        assert shown.object_verts is not None and len(shown.object_verts) == count
        last = read_mask(given.masks / f"{count - 1:04d}.png")
        true = clip.mask(int(given.frames[-1]))
        assert np.array_equal(last == MASK_VALUES["object"], true == MASK_VALUES["object"])
        assert (last == MASK_VALUES["left"]).any() == ("left" in variant.hands)


def test_contrast_is_cut_on_the_object_alone(tiny_clip: Path, tmp_path: Path) -> None:
    clip, truth = load_hold(tiny_clip), load_ground_truth(tiny_clip)
    given = write_variant(tmp_path, clip, truth, VARIANTS["contrast-20"])
    on_object = clip.mask(0) == MASK_VALUES["object"]
    before, after = clip.image(0).astype(float), read_image(given.pictures / "0000.png").astype(float)
    assert after[on_object].std(0).max() < 0.35 * before[on_object].std(0).max()
    assert np.abs(after - before)[~on_object].mean() < 2.0


def test_keypoints_err_as_they_are_told() -> None:
    joints = np.random.default_rng(0).normal(0.0, 0.03, (200, 21, 3)) + np.array([0, 0, 0.6])
    pixels = joints @ K.T
    true = pixels[..., :2] / pixels[..., 2:]

    def errors(noise: KeypointNoise) -> tuple[np.ndarray, np.ndarray, list[dict[str, object]]]:
        rows = simulated_keypoints({"right": joints}, K, noise, np.random.default_rng(1))
        table = np.array([row["right"] or np.full((21, 3), np.nan) for row in rows], dtype=float)
        return np.linalg.norm(table[..., :2] - true, axis=-1), table[..., 2], rows

    apart, sure, _ = errors(KeypointNoise(sigma=3.0))
    assert np.sqrt((apart**2).mean() / 2) == pytest.approx(3.0, rel=0.05) and (sure > 0).all()
    apart, sure, rows = errors(KeypointNoise(sigma=1.0, outliers=0.1, dropouts=0.2, missing=0.1))
    assert np.nanmean(apart > 8.0) == pytest.approx(0.1, abs=0.03)
    assert np.nanmean(sure == 0.0) == pytest.approx(0.2, abs=0.03)
    assert np.mean([row["right"] is None for row in rows]) == pytest.approx(0.1, abs=0.06)


def test_the_page_has_failures_and_what_was_shipped(
    tiny_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(request: PreprocessRequest, listen: Callable[[str], None]) -> list[StepOutcome]:
        raise InputError(f"{request.keypoints}: expected more, found less")

    monkeypatch.setattr(bench_preprocess, "preprocess", refuse)
    plan = PreprocessPlan((tiny_clip,), ("plain", "half"))
    found = bench_preprocess.bench_preprocess(plan, tmp_path / "out")
    assert [text.split(": ")[1] for text in found.failed] == ["plain", "half"]
    page = (tmp_path / "out" / "preprocess.md").read_text()
    assert "expected more, found less" in page and "| shipped |" in page
    runs = json.loads((tmp_path / "out" / "preprocess.json").read_text())["runs"]
    assert [run["frames"] for run in runs] == [12, 6]


def test_unknown_variants_and_clips_without_truth_are_refused(
    call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path
) -> None:
    answer = call("bench", "preprocess", str(tiny_clip), "--variants", "foggy", "--out", str(tmp_path / "o"))
    assert_refused(answer, "--variants", "plain", "foggy")
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "build").symlink_to(tiny_clip / "build")
    answer = call("bench", "preprocess", str(bare), "--out", str(tmp_path / "o"))
    assert_refused(answer, "expected a clip with gt.npz")
    assert not (tmp_path / "o").exists()

"""Scores of a finished run: from every source of truth, per frame, of held-out views, beside the paper."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import Answer, Run, assert_refused
from PIL import Image
from small_vgg import lpips_channels, torchvision_state

from bigs.commands.evaluate.paper_tables import RunInput, beside_paper
from bigs.commands.evaluate.picture_scores import novel_scores
from bigs.commands.evaluate.runs import Evaluation, EvaluationPlan, compare_runs, evaluate_run
from bigs.commands.render.frame import render_frame
from bigs.data.base import Clip
from bigs.data.formats.ho3d import CV_FROM_GL
from bigs.data.formats.writers import write_arctic, write_ho3d
from bigs.data.ground_truth import load_annotation
from bigs.data.moving import in_world
from bigs.hand import HandModel
from bigs.metrics.picture import ALL_METRICS
from bigs.models.playback_file import load_playback
from bigs.types import Side

pytestmark = pytest.mark.slow


@pytest.fixture
def run(tmp_path: Path, finished_run: Run) -> Path:
    shutil.copytree(finished_run.folder, tmp_path / "run")
    return tmp_path / "run"


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory, finished_run: Run) -> Evaluation:
    """The finished run scored by its own clip, once for all."""
    copy = tmp_path_factory.mktemp("own") / "run"
    shutil.copytree(finished_run.folder, copy)
    return evaluate_run(copy, EvaluationPlan())


def columns(file: Path) -> dict[str, np.ndarray]:
    with file.open() as stream:
        rows = list(csv.DictReader(stream))
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


def test_the_runs_own_clip_gives_everything(run: Path, tiny: Clip) -> None:
    before = json.loads((run / "metrics.json").read_text())
    found = evaluate_run(run, EvaluationPlan())
    after = json.loads((run / "metrics.json").read_text())
    assert after["initial"] == before["initial"] and after == found.scores
    for key, value in before["result"].items():
        assert after["result"][key] == pytest.approx(value, rel=1e-6), key
    table = columns(run / "frames.csv")
    np.testing.assert_array_equal(table["name"], tiny.frame_names)
    assert {"mpjpe_ra_r", "cd_l_sq", "mrrpe_r", "psnr_foreground", "ssim_inside"} <= set(table)
    for key, texts in table.items():
        if key not in ("frame", "name"):
            over_frames = np.median if key == "rotation" else np.mean
            assert after["result"][key] == pytest.approx(over_frames(texts.astype(float)), rel=1e-4), key
    assert found.remarks == ("LPIPS is not scored: no weights (--perceptual-weights)",)


def test_arctics_layout_is_the_same_truth(
    run: Path, own: Evaluation, tiny: Clip, tiny_clip: Path, tmp_path: Path
) -> None:
    annotation = load_annotation(tiny_clip)
    images = [tiny.image(t) for t in range(len(tiny))]
    write_arctic(
        tmp_path / "arctic", annotation, subject="s01", sequence="bottle_grab_01", images=images, offset=0
    )
    plan = EvaluationPlan(ground_truth=tmp_path / "arctic" / "s01" / "bottle_grab_01" / "1")
    found = evaluate_run(run, plan)
    other = found.scores["result"]
    assert "the data set's poses are on the built-in hand" in found.remarks[0]
    for key, value in own.scores["result"].items():
        assert other[key] == pytest.approx(value, rel=1e-3, abs=1e-4), key


def test_ho3ds_truth_has_one_hand_and_knows_some_frames(
    run: Path,
    own: Evaluation,
    tiny: Clip,
    tiny_clip: Path,
    tmp_path: Path,
    both_hands: dict[Side, HandModel],
) -> None:
    annotation = load_annotation(tiny_clip)
    rest = {}
    for side, track in annotation.hands.items():
        betas = torch.as_tensor(track.betas, dtype=torch.float32)
        rest[side] = both_hands[side].rest_joints(betas)[0].double().numpy()
    annotation = in_world(annotation, CV_FROM_GL, rest)
    assert annotation.object is not None
    annotation.object.valid[[3, 4]] = False
    folder = write_ho3d(
        tmp_path / "ho3d",
        annotation,
        clip="SM1",
        object_name="bottle",
        images=[tiny.image(t) for t in range(len(tiny))],
        hands_mean=np.asarray(both_hands["right"].hands_mean),
    )
    # HO-3D writes four digits; the clip was made with five.
    for part, suffix in (("meta", "pkl"), ("rgb", "jpg")):
        for t in range(len(tiny)):
            (folder / part / f"{t:04d}.{suffix}").rename(folder / part / f"{t:05d}.{suffix}")
    found = evaluate_run(run, EvaluationPlan(ground_truth=folder))
    assert "mpjpe_ra_l" not in found.frames and np.isnan(found.frames["mpjpe_ra_r"][[3, 4]]).all()
    known = [t for t in range(len(tiny)) if t not in (3, 4)]
    for key in ("mpjpe_ra_r", "cd_r_sq", "mrrpe_r"):
        np.testing.assert_allclose(found.frames[key][known], own.frames[key][known], rtol=1e-3)
        assert found.scores["result"][key] == pytest.approx(own.frames[key][known].mean(), rel=1e-3)


def test_a_data_sets_truth_is_on_its_own_hands(
    run: Path, tiny: Clip, tiny_clip: Path, tmp_path: Path, call: Callable[..., Answer]
) -> None:
    """The run's hand model has gone: no other may stand in for it, unless gt.npz needs none."""
    images = [tiny.image(t) for t in range(len(tiny))]
    write_arctic(
        tmp_path / "arctic",
        load_annotation(tiny_clip),
        subject="s01",
        sequence="bottle_grab_01",
        images=images,
        offset=0,
    )
    config = run / "config.yaml"
    config.write_text(config.read_text().replace("hand_model: null", f"hand_model: {tmp_path}/gone"))
    assert_refused(call("eval", run, "--gt", tmp_path / "arctic" / "s01"), f"{tmp_path}/gone")
    assert call("eval", run, "--gt", tiny_clip).code == 0


def test_a_held_back_view_from_the_clips_own_camera(run: Path, tiny: Clip, tmp_path: Path) -> None:
    times = [7, 2]
    for part, frame in (("image", tiny.image), ("mask", tiny.mask)):
        (tmp_path / "novel" / part).mkdir(parents=True)
        for index, t in enumerate(times):
            Image.fromarray(frame(t)).save(tmp_path / "novel" / part / f"{index:04d}.png")
    arrays = {
        "K": np.stack([tiny.K] * 2),
        "R": np.stack([np.eye(3)] * 2),
        "t": np.zeros((2, 3)),
        "frame": np.array(times),
        "wh": np.array([tiny.width, tiny.height]),
    }
    np.savez(tmp_path / "novel" / "cameras.npz", **arrays)
    found = evaluate_run(run, EvaluationPlan(novel=tmp_path / "novel"))
    for key in ("psnr_full", "psnr_foreground", "ssim_inside"):
        assert found.scores["result"][f"novel_{key}"] == pytest.approx(
            found.frames[key][times].mean(), rel=1e-5
        )
    np.savez(tmp_path / "novel" / "cameras.npz", **(arrays | {"frame": np.array([7, 12])}))
    with pytest.raises(ValueError, match="frame: expected times from 0 to 11, found 7 to 12"):
        evaluate_run(run, EvaluationPlan(novel=tmp_path / "novel"))


def test_held_back_views_of_a_clip_of_another_size(run: Path, tiny: Clip, tmp_path: Path) -> None:
    """A clip of half the size, seen by a camera half as far from the clip's, looks the same."""
    playback = load_playback(run / "scene.safetensors")
    turned = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    away = np.array([0.5, 0.0, 0.6])
    view, _ = render_frame(
        playback,
        3,
        torch.tensor(np.block([[turned, away[:, None]], [np.zeros(3), np.ones(1)]]), dtype=torch.float32),
        torch.tensor(tiny.K, dtype=torch.float32),
        tiny.width,
        tiny.height,
    )
    for part, pixels in (("image", (255 * view.clip(0, 1)).round()), ("mask", 50 * (view.sum(-1) > 0))):
        (tmp_path / part).mkdir()
        Image.fromarray(pixels.astype(np.uint8)).save(tmp_path / part / "0000.png")
    same = {"K": tiny.K[None], "R": turned[None], "frame": np.array([3]), "wh": [tiny.width, tiny.height]}
    np.savez(tmp_path / "cameras.npz", **same, t=2.0 * away[None])
    scores = novel_scores(playback, tmp_path, scale=2.0)
    assert scores["novel_scaled_psnr_foreground"] > 50.0 > scores["novel_psnr_foreground"]
    assert not any(key.startswith("novel_scaled_") for key in novel_scores(playback, tmp_path))


def test_lpips_needs_both_files(run: Path, call: Callable[..., Answer], tmp_path: Path) -> None:
    torch.save(torchvision_state(), tmp_path / "vgg.pth")
    torch.save(lpips_channels(), tmp_path / "lin.pth")
    refused = call("eval", run, "--perceptual-weights", tmp_path / "vgg.pth")
    assert_refused(refused, "--perceptual-weights: expected LPIPS's channel weights", "vgg.pth")
    files = (tmp_path / "vgg.pth", tmp_path / "lin.pth")
    answer = call("eval", run, "--all", "--perceptual-weights", *files)
    assert answer.code == 0 and "LPIPS of the foreground" in answer.out
    result = json.loads((run / "metrics.json").read_text())["result"]
    assert 0 < result["lpips_foreground"] < result["lpips_full"]


def test_runs_stand_beside_the_paper(run: Path, call: Callable[..., Answer], tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "other")
    answer = call("eval", run, tmp_path / "other", "--out", tmp_path / "table")
    assert answer.code == 0, answer.err
    text = (tmp_path / "table" / "comparison.md").read_text()
    frames = len(columns(run / "frames.csv")["frame"])
    for row in (f"| run ({frames} frames) |", f"| other ({frames} frames) |", "| mean of 2 |"):
        assert row in text
    assert "paper: " not in text and "computes CD_r and CD_l from plain" in text
    table = columns(tmp_path / "table" / "comparison.csv")
    result = json.loads((run / "metrics.json").read_text())["result"]
    np.testing.assert_array_equal(table["run"], ["run", "other"])
    for key in ALL_METRICS:
        if key in result:
            assert float(table[key][1]) == pytest.approx(result[key]), key


def test_a_run_without_left_hand_stands_beside_table_2() -> None:
    one = {"mpjpe_ra_r": 10.0, "cd_r_sq": 2.0, "cd_icp_sq": 0.5, "f10_icp": 90.0}
    clips = dict.fromkeys(("SM1", "SM2"), RunInput("HO-3D"))
    (table,) = beside_paper({"SM1": one, "SM2": one | {"cd_r_sq": 4.0}}, clips)
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["SM1"] == ("2.00", "0.50", "90.00", "10.00") and rows["mean of 2"][0] == "3.00"
    assert rows["paper: limited view: BIGS"] == ("21.70", "1.24", "84.02", "24.22")
    assert rows["paper: full view: HOMan"] == ("78.20", "-", "-", "32.00")


def test_the_papers_rows_stand_beside_its_own_data_alone() -> None:
    one = {"mpjpe_ra_r": 10.0, "mpjpe_ra_l": 10.0, "psnr_full": 20.0}
    two, drawn = beside_paper({"a": one}, {"a": RunInput("", "16 frames, generated")})
    assert [row[0] for row in two.rows] == [row[0] for row in drawn.rows] == ["", "a (16 frames, generated)"]
    assert "ARCTIC" not in two.title and "paper" not in drawn.title
    two, drawn = beside_paper({"a": one}, {"a": RunInput("ARCTIC")})
    assert "paper: BIGS" in {row[0] for row in two.rows}
    assert {row[0] for row in drawn.rows[2:]} == {"paper: ARCTIC: HOLD", "paper: ARCTIC: BIGS"}


def test_nothing_to_score_against(run: Path, call: Callable[..., Answer], tmp_path: Path) -> None:
    config = run / "config.yaml"
    lines = [
        line if not line.startswith("clip:") else f"clip: {tmp_path}/gone"
        for line in config.read_text().splitlines()
    ]
    config.write_text("\n".join(lines))
    assert_refused(call("eval", run), "expected something to score against", f"{tmp_path}/gone")
    assert_refused(call("eval"), "expected a run folder, found none")
    assert_refused(call("eval", run, run), "expected each run once")
    assert_refused(call("eval", run, tmp_path, "--gt", run), "--gt: expected one run with it, found 2")


def test_another_clip_is_refused(
    run: Path, call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path
) -> None:
    shutil.copytree(tiny_clip, tmp_path / "clip")
    names = (tmp_path / "clip" / "build" / "corres.txt").read_text().replace("0000", "1000")
    (tmp_path / "clip" / "build" / "corres.txt").write_text(names)
    answer = call("eval", run, "--clip", tmp_path / "clip")
    assert_refused(answer, "expected the run's 12 frames from 00000.png on", "found 12 from 10000.png on")


def test_a_submission_from_runs(run: Path, call: Callable[..., Answer], tiny: Clip, tmp_path: Path) -> None:
    archive = tmp_path / "arctic_preds.zip"
    answer = call("submission", archive, "--runs", run, "--sequences", tiny.name)
    assert answer.code == 0 and "is complete" in answer.out and tiny.name in answer.out
    assert call("submission", archive, "--sequences", tiny.name).code == 0
    assert_refused(call("submission", archive), "expected the 9 sequences of the challenge")
    assert_refused(call("submission", archive, "--hold-class"), "--hold-class: expected --runs with it")
    assert_refused(
        call("submission", archive, "--runs", tmp_path), "arctic_preds: expected the run's prediction"
    )


def test_a_comparison_names_what_it_shows(own: Evaluation, tmp_path: Path) -> None:
    tables = compare_runs({"only": own}, tmp_path / "out")
    assert [row[0] for row in tables[0].rows][:2] == ["", "only (12 frames)"]
    assert not any(row[0].startswith("mean") for table in tables for row in table.rows)

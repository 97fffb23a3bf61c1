"""`bigs preprocess` and `bigs reconstruct video.mp4` as a user calls them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import Answer, assert_refused
from taken_apart import Given, place_true_object

from bigs.data.formats.hold import load_hold
from bigs.data.images import read_image
from bigs.train.plan.config import OptimizeStage
from bigs.train.plan.presets import SMOKE
from bigs.viewer.preview import write_video

Call = Callable[..., Answer]


@pytest.fixture(scope="module")
def video(given: Given, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("av")
    file = tmp_path_factory.mktemp("video") / "video.mp4"
    write_video(file, [read_image(path) for path in sorted(given.pictures.glob("*.png"))], 25)
    return file


def options(given: Given) -> list[str]:
    return ["--masks", str(given.masks), "--keypoints", str(given.keypoints), *given.camera]


@pytest.mark.slow
def test_a_video_becomes_a_finished_run(call: Call, given: Given, video: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    place_true_object(run / "clip", given.truth)
    stages = [stage.name for stage in SMOKE.stages if isinstance(stage, OptimizeStage)]
    quick = [f"--set=stages.{stage}.{change}" for stage in stages for change in ("steps=2", "image_size=40")]
    command = ["reconstruct", str(video), "--out", str(run), "--preset", "smoke", *quick, *options(given)]
    answer = call(*command)
    assert answer.code == 0, answer.err
    assert "frames  made" in answer.out and "hands   made" in answer.out and "build   made" in answer.out
    assert (run / "poses.npz").is_file() and (run / "report.html").is_file()
    clip = load_hold(run / "clip")
    assert len(clip) == 12 and clip.frame_names[3] == "000003.png" and clip.fps == 25.0
    # Video is lossy, but it is the same picture.
    true = read_image(sorted(given.pictures.glob("*.png"))[3]).astype(float)
    assert np.abs(clip.image(3) - true).mean() < 6.0
    # Resuming finds the clip up to date and the run finished.
    again = call(*command, "--resume")
    assert again.code == 0 and "hands   up to date" in again.out


@pytest.mark.slow
def test_the_steps_by_themselves(call: Call, given: Given, tmp_path: Path) -> None:
    clip = tmp_path / "clip"
    place_true_object(clip, given.truth)
    for command in (
        ["frames", str(given.pictures), "--out", str(clip), *given.camera],
        ["masks", str(clip), "--masks", str(given.masks)],
        ["hands", str(clip), "--keypoints", str(given.keypoints)],
        ["object", str(clip)],
        ["align", str(clip)],
        ["build", str(clip)],
    ):
        answer = call("preprocess", *command)
        assert answer.code == 0, answer.err
        assert answer.out.startswith(command[0])
    assert load_hold(clip).hands.keys() == {"right", "left"}
    whole = call("preprocess", str(given.pictures), "--out", str(clip), *options(given))
    assert whole.code == 0 and "  made" not in whole.out


def test_the_rate_is_said_on_the_command_line(call: Call, given: Given, tmp_path: Path) -> None:
    clip = tmp_path / "clip"
    command = ["frames", str(given.pictures), "--out", str(clip), "--fps", "24", "--stride", "2"]
    assert "at 12 a second" in call("preprocess", *command).out
    assert json.loads((clip / "processed" / "frames.json").read_text())["fps"] == 12.0


def test_labels_of_masks_are_said_on_the_command_line(call: Call, given: Given, tmp_path: Path) -> None:
    clip = tmp_path / "clip"
    assert call("preprocess", "frames", str(given.pictures), "--out", str(clip)).code == 0
    wrong = ("right=50", "left=250", "object=150")
    answer = call("preprocess", "masks", str(clip), "--masks", str(given.masks), "--mask-labels", *wrong)
    assert answer.code == 0
    areas = json.loads((clip / "processed" / "masks.json").read_text())["areas"]
    swapped = load_hold(given.truth).mask_areas
    assert areas["right"] == swapped["object"].tolist() and areas["object"] == swapped["right"].tolist()


def test_refusals_are_one_sentence(call: Call, given: Given, tmp_path: Path) -> None:
    clip, none = tmp_path / "clip", tmp_path / "none"
    everything = options(given)
    keypoints = everything[2:]
    without_object = tmp_path / "bare"
    shutil.copytree(given.masks, without_object / "right")
    for arguments, words in (
        (
            ["preprocess", str(none), "--out", str(clip)],
            ["none", "expected a video file or a folder", "nothing"],
        ),
        (["preprocess", str(given.pictures), "--out", str(clip)], ["expected masks", "give --masks DIR"]),
        (
            ["preprocess", str(given.pictures), "--out", str(clip), *everything[:2]],
            ["expected estimates of the hands", "give --keypoints FILE"],
        ),
        (
            ["preprocess", str(given.pictures), "--out", str(clip), "--masks", str(none)],
            ["none: expected a folder of masks, found nothing"],
        ),
        (
            [
                "preprocess",
                str(given.pictures),
                "--out",
                str(clip),
                "--masks",
                str(without_object),
                *keypoints,
            ],
            ["expected an object in the video", "no object pixel in any of 12 frames", "give masks"],
        ),
        (
            ["preprocess", str(given.pictures), "--out", str(clip), "--sam2", str(none), *keypoints],
            ["none: expected a folder with the weights", "found no such folder", "--masks"],
        ),
        (
            ["preprocess", str(given.pictures), "--out", str(clip), "--sam2", str(clip), *keypoints],
            ["--sam2: expected --clicks FILE"],
        ),
        (
            [
                "preprocess",
                str(given.pictures),
                "--out",
                str(clip),
                *everything[:2],
                "--keypoints",
                str(none),
            ],
            ["none: expected a file for --keypoints, found nothing"],
        ),
        (
            ["preprocess", str(given.pictures), "--out", str(clip), *everything, "--hands", str(none)],
            ["expected one of --keypoints, --hands, --landmarker"],
        ),
        (["preprocess", "masks", str(clip), "--mask-labels", "cup=3"], ["--mask-labels", "found 'cup=3'"]),
        (["preprocess", "hands", str(none)], ["frames.json: expected what an earlier step writes"]),
        (
            ["reconstruct", str(given.truth), "--out", str(clip / "r"), "--masks", str(given.masks)],
            ["expected a video or a folder of images for --masks, found a clip"],
        ),
    ):
        answer = call(*arguments)
        # Steps before the one that fails may have told of themselves.
        assert_refused(answer._replace(out=""), *words)
        assert answer.code == 2
    assert not (clip / "build").exists()


def test_preprocess_alone_is_the_whole_of_it(call: Call) -> None:
    assert call("preprocess", "x", "--help").out == call("preprocess", "all", "x", "--help").out

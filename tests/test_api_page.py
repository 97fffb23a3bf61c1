"""What the page of the Python API promises: its functions are there, and a wrong shape is one sentence."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import Run

from bigs.checks import InputError
from bigs.commands.folder.contents import load_run
from bigs.commands.render.frame import render_depth, render_frame
from bigs.data.base import Clip
from bigs.data.moving import move_hand, move_object
from bigs.hand import load_hand_models
from bigs.metrics import align, image, pose, shape
from bigs.metrics.picture import picture_scores
from bigs.metrics.report import evaluate, per_frame
from bigs.models.playback import Playback
from bigs.models.repose import bend_fingers, repose, turn_object
from bigs.raster import gsplat, rasterization

PAGE = (Path(__file__).parents[1] / "docs" / "api.md").read_text()

# Those that take files, folders, names or configurations, but no array: other tests give them bad ones.
OF_FILES = {
    "bigs.commands.run.reconstruct.reconstruct",
    "bigs.commands.preprocess.all_steps.preprocess",
    "bigs.commands.clips.convert.convert",
    "bigs.commands.evaluate.runs.evaluate_run",
    "bigs.commands.clips.truth.load_truth",
    "bigs.commands.render.views.render_run",
    "bigs.data.load_clip",
    "bigs.data.load_hold",
    "bigs.data.write_hold",
    "bigs.data.synthetic.make_clip",
    "bigs.export.submission.write_submission",
    "bigs.train.plan.config_file.with_changes",
    "bigs.train.fit.fit",
    "bigs.train.switches.without_all",
}


class Things:
    """Good inputs, to be spoilt one at a time."""

    def __init__(self, playback: Playback, clip: Clip) -> None:
        self.playback, self.clip = playback, clip
        self.right = load_hand_models(None)["right"]
        self.hand, self.object = playback.hands["right"], playback.object
        self.truth = playback.trajectory()
        self.posed = (torch.zeros(10), torch.eye(3).expand(4, 15, 3, 3), torch.eye(3).expand(4, 3, 3))
        self.gaussians = (torch.zeros(5, 3), torch.ones(5, 4), torch.ones(5, 3), torch.ones(5))
        self.cameras = (torch.eye(4)[None], torch.eye(3)[None], 8, 6)
        self.points = np.zeros((7, 3))


def changed_truth(t: Things) -> Any:
    """A trajectory whose joints lack one."""
    import dataclasses

    return dataclasses.replace(t.truth, joints={"right": t.truth.joints["right"][:, :20]})


Call = Callable[[Things], Any]
# For each function calls with one wrong shape, and the words that name it.
WRONG: dict[str, list[tuple[Call, str]]] = {
    "right": [
        (lambda t: t.right(torch.zeros(9), *t.posed[1:], torch.zeros(4, 3)), r"betas: .*10\], found \[9\]"),
        (
            lambda t: t.right(t.posed[0], t.posed[1][:, :14], t.posed[2], torch.zeros(4, 3)),
            r"hand_pose: expected shape \[T, 15, 3, 3\], found \[4, 14, 3, 3\]",
        ),
        (
            lambda t: t.right(*t.posed[:2], torch.eye(3), torch.zeros(4, 3)),
            r"global_orient: expected shape \[4, 3, 3\], found \[3, 3\]",
        ),
        (lambda t: t.right(*t.posed, torch.zeros(3)), r"wrist: expected shape \[4, 3\], found \[3\]"),
    ],
    "right.pose_matrices": [
        (
            lambda t: t.right.pose_matrices(torch.zeros(4, 45)),
            r"hand_pose: expected shape \[\.\.\., 15, 3\], found \[4, 45\]",
        ),
        (lambda t: t.right.pose_matrices([0.0] * 45), "hand_pose: expected an array, found list"),
    ],
    "right.pose_axis_angle": [
        (lambda t: t.right.pose_axis_angle(torch.zeros(15, 3)), r"hand_pose: .*3, 3\], found \[15, 3\]")
    ],
    "right.rest_vertices": [(lambda t: t.right.rest_vertices(torch.zeros(3)), r"betas: .*found \[3\]")],
    "right.rest_joints": [(lambda t: t.right.rest_joints(torch.zeros(())), r"betas: .*found \[\]")],
    "playback.gaussians": [(lambda t: t.playback.gaussians([0, 12]), "frames: .* 0 to 11, found 12")],
    "bigs.commands.render.frame.render_frame": [
        (lambda t: render_frame(t.playback, 0, torch.eye(3), torch.eye(3), 4, 4), r"viewmat: .*\[4, 4\]"),
        (lambda t: render_frame(t.playback, 0, torch.eye(4), torch.eye(4), 4, 4), r"K: .*\[3, 3\]"),
        (lambda t: render_frame(t.playback, -1, torch.eye(4), torch.eye(3), 4, 4), "frames: .*found -1"),
    ],
    "bigs.commands.render.frame.render_depth": [
        (lambda t: render_depth(t.playback, 0, torch.eye(3), torch.eye(3), 4, 4), r"viewmat: .*\[4, 4\]"),
        (lambda t: render_depth(t.playback, 0, torch.eye(4), torch.eye(4), 4, 4), r"K: .*\[3, 3\]"),
    ],
    "bigs.models.repose.repose": [
        (
            lambda t: repose(t.hand, "right", t.posed[1][:, 1:], t.posed[2], torch.zeros(4, 3)),
            r"hand_pose: expected shape \[T, 15, 3, 3\]",
        ),
        (lambda t: repose(t.hand, "right", *t.posed[1:], torch.zeros(3, 3)), r"wrist: .*\[4, 3\]"),
    ],
    "bigs.models.repose.bend_fingers": [
        (lambda t: bend_fingers(t.hand, "right", {"toe": 3.0}), "finger: expected one of thumb.*toe")
    ],
    "bigs.models.repose.turn_object": [
        (lambda t: turn_object(t.object, torch.zeros(3)), r"rotation: expected shape \[3, 3\], found \[3\]")
    ],
    "bigs.raster.gsplat.rasterization": [
        (
            lambda t: gsplat.rasterization(*t.gaussians, torch.ones(4, 3), *t.cameras),
            r"colors: expected shape \[\.\.\., 5, 3\], found \[4, 3\]",
        )
    ],
    "rasterization": [
        (
            lambda t: rasterization(*t.gaussians, torch.ones(5, 3), torch.eye(4), *t.cameras[1:]),
            r"viewmats: expected shape \[\.\.\., 1, 4, 4\], found \[4, 4\]",
        )
    ],
    "bigs.metrics.report.evaluate": [(lambda t: evaluate(changed_truth(t), t.truth), "joints .*21, 3")],
    "bigs.metrics.report.per_frame": [(lambda t: per_frame(changed_truth(t), t.truth), "joints .*21, 3")],
    "bigs.metrics.picture.picture_scores": [
        (
            lambda t: picture_scores(np.zeros((4, 5, 3)), np.zeros((5, 4, 3)), np.ones((4, 5), bool)),
            r"image: expected shape \[4, 5, 3\], found \[5, 4, 3\]",
        ),
        (
            lambda t: picture_scores(np.zeros((4, 5, 3)), np.zeros((4, 5, 3)), np.ones((4, 5, 1), bool)),
            r"mask: expected shape \[4, 5\], found \[4, 5, 1\]",
        ),
    ],
    "bigs.metrics.pose.mpjpe": [
        (lambda t: pose.mpjpe(np.zeros((2, 21, 3)), np.zeros((3, 21, 3))), r"gt: .*\[2, 21, 3\]")
    ],
    "bigs.metrics.pose.wrist_error": [
        (lambda t: pose.wrist_error(np.zeros((21, 3)), np.zeros((21, 3))), r"pred: .*\[T, J, 3\]")
    ],
    "bigs.metrics.pose.clip_scale": [
        (lambda t: pose.clip_scale(np.zeros((5, 2)), np.zeros((5, 2))), r"pred_points: .*\[\.\.\., 3\]")
    ],
    "bigs.metrics.shape.chamfer": [
        (lambda t: shape.chamfer(t.points[:, :2], t.points), r"predicted points: .*\[N, 3\], found \[7, 2\]")
    ],
    "bigs.metrics.shape.f_score": [
        (lambda t: shape.f_score(t.points, t.points[0], 5.0), r"true points: .*\[N, 3\], found \[3\]")
    ],
    "bigs.metrics.shape.shape_score": [
        (lambda t: shape.shape_score(t.points[None], t.points), r"predicted points: .*found \[1, 7, 3\]")
    ],
    "bigs.metrics.align.similarity_icp": [
        (lambda t: align.similarity_icp(t.points[0], t.points), r"source: .*\[N, 3\], found \[3\]"),
        (
            lambda t: align.similarity_icp(t.points, t.points, None, np.zeros((2, 4), int)),
            r"target_faces: expected shape \[F, 3\], found \[2, 4\]",
        ),
    ],
    "bigs.metrics.image.psnr": [
        (lambda t: image.psnr(torch.zeros(3, 4, 4), torch.zeros(3, 4, 4)), r"pred: .*\[B, C, H, W\]")
    ],
    "bigs.metrics.image.ssim": [
        (lambda t: image.ssim(torch.zeros(1, 3, 16, 16), torch.zeros(1, 3, 16, 8)), r"gt: .*16, 16\]")
    ],
    "bigs.data.moving.move_hand": [
        (
            lambda t: move_hand(t.clip.hands["right"], np.eye(4), np.zeros(3)),
            r"new_from_old: expected shape \[12, 4, 4\], found \[4, 4\]",
        ),
    ],
    "bigs.data.moving.move_object": [
        (lambda t: move_object(t.clip.object, np.eye(4)), r"new_from_old: expected shape \[12, 4, 4\]")
    ],
}


@pytest.fixture(scope="module")
def things(finished_run: Run, tiny: Clip) -> Things:
    return Things(load_run(finished_run.folder), tiny)


def named() -> set[str]:
    """Every function that the page writes with its arguments or by its dotted name."""
    text = re.sub(r"^```.*?^```", "", PAGE, flags=re.M | re.S)
    calls = {name for code in re.findall("`([^`]+)`", text) for name in re.findall(r"^([\w.]+)\(", code)}
    return calls | {"rasterization", "bigs.raster.gsplat.rasterization"}


def test_every_function_of_the_page_is_tried() -> None:
    assert named() - OF_FILES == set(WRONG)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(WRONG))
def test_a_wrong_shape_is_one_sentence(things: Things, name: str) -> None:
    for call, words in WRONG[name]:
        with pytest.raises(InputError, match=words) as caught:
            call(things)
        assert "\n" not in str(caught.value)


def test_the_table_of_gsplats_arguments_is_whole() -> None:
    rows = re.findall(
        r"^\| (`[^|]+) \| ([^|]+) \|$", PAGE.split("### gsplat's call")[1].split("## Scores")[0], re.M
    )
    told = {name: text for names, text in rows for name in re.findall(r"`(\w+)`", names)}
    assert list(told) and set(told) == set(inspect.signature(gsplat.rasterization).parameters)
    refused = {name: text for name, text in told.items() if text.startswith("refused")}
    assert set(refused) == set(gsplat._WHY)
    for name, text in refused.items():
        assert text.removeprefix("refused: ").startswith(gsplat._WHY[name])

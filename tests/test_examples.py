"""The examples run as they are shown, with small settings, and make what they promise."""

from __future__ import annotations

import ast
import importlib.util
import io
import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import trimesh
from command_line import Run
from PIL import Image

from bigs.checks import InputError
from bigs.commands.folder.contents import load_run
from bigs.data.formats.hold import load_hold
from bigs.export.submission import check_submission
from bigs.hand import load_hand_models
from bigs.train.start.initial import initial_trajectory
from bigs.types import Side

EXAMPLES = Path(__file__).parents[1] / "examples"


def load(name: str) -> ModuleType:
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pixels(path: Path) -> np.ndarray:
    """A picture as floats [H, W, 3] in [0, 1]."""
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")) / 255.0


def test_every_example_has_a_test_a_purpose_and_a_main() -> None:
    names = {path.stem for path in EXAMPLES.glob("*.py")}
    assert names == {
        "render_gaussians",
        "fit_image",
        "pose_hand",
        "gsplat_script",
        "reconstruct_arctic",
        "reconstruct_ho3d",
        "reconstruct_video",
        "novel_pose",
        "train_prior",
    }
    for name in names:
        tree = ast.parse((EXAMPLES / f"{name}.py").read_text())
        assert "Key ideas:" in (ast.get_docstring(tree) or "")
        functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
        assert ast.get_docstring(functions["main"])


def test_render_gaussians(tmp_path: Path) -> None:
    load("render_gaussians").main(tmp_path, count=2000, width=64, height=64)
    views = np.split(pixels(tmp_path / "colors.png"), 3, axis=1)
    corners = np.stack([view[[0, 0, -1, -1], [0, -1, 0, -1]] for view in views])
    assert (corners == 1.0).all()
    for view in views:
        drawn = (view < 0.95).any(axis=-1).mean()
        assert 0.15 < drawn < 0.7
    assert np.abs(views[0] - views[1]).mean() > 0.05
    depth = pixels(tmp_path / "depth.png")
    assert depth.max() == 1.0 and (depth[0] == 0.0).all()


def test_fit_image(tmp_path: Path) -> None:
    before, after = load("fit_image").main(tmp_path, count=150, steps=60, width=48, height=36)
    assert after > before + 8.0
    target, start, end = np.split(pixels(tmp_path / "fit.png"), 3, axis=1)
    assert np.abs(end - target).mean() < 0.3 * np.abs(start - target).mean()


def test_gsplat_script(tmp_path: Path) -> None:
    before, after, count = load("gsplat_script").main(tmp_path, count=150, steps=100, size=32, views=4)
    assert after > before + 5.0
    # A fifth of the Gaussians, those with the largest gradients on screen, were split in two.
    assert count == 180
    views, fit = np.split(pixels(tmp_path / "views.png"), 2, axis=0)
    assert np.abs(fit - views).mean() < 0.1


def test_pose_hand(tmp_path: Path) -> None:
    load("pose_hand").main(tmp_path, width=96, height=72)
    flat, fist = (pixels(tmp_path / "hands.png")[24:, x : x + 240] for x in (56, -244))
    # The left hand is the right hand in the mirror, in every stage.
    assert np.abs(flat - flat[:, ::-1]).mean() < 0.02
    assert np.abs(flat - fist).mean() > 0.02
    mesh = trimesh.load(tmp_path / "right_fist.ply")
    assert mesh.is_watertight and 0.05 < mesh.extents.max() < 0.2


def test_train_prior(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With hardly any training: every held-out object is scored, in a table that says what was found."""
    example = load("train_prior")
    found = example.main(tmp_path, learn_from=2, held_out=2, steps=2, width=16, stage_steps=2)
    assert [one.name for one in found] == ["010000", "010001"]
    lines = (tmp_path / "prior.md").read_text().splitlines()
    assert capsys.readouterr().out.splitlines()[-len(lines) :] == lines
    mean = [float(cell) for cell in lines[-1].split("|")[2:-1]]
    assert abs(mean[0] - np.mean([one.before.chamfer.squared for one in found])) < 0.01
    assert abs(mean[3] - np.mean([one.after.f10 for one in found])) < 0.1
    # Flat backs are far from the truth, whatever their kind; two steps move them, hardly.
    assert all(one.before.chamfer.squared > 1.0 and one.before != one.after for one in found)
    again = example.main(tmp_path, prior=tmp_path / "prior.safetensors", held_out=1, stage_steps=2)
    assert again == found[:1]


@pytest.mark.slow
def test_reconstruct_arctic(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example = load("reconstruct_arctic")
    archive = example.main(tmp_path / "arctic", frames=8)
    (clip,) = check_submission(archive, [example.STAND_IN])
    assert clip.frames == 8
    rows = {line.split("  ")[0]: line.split() for line in capsys.readouterr().out.splitlines()}
    assert "8 frames submitted" in " ".join(rows[f"{example.STAND_IN}: 8 frames submitted"])
    # The paper's figures are of ARCTIC's own clips.
    assert f"{example.STAND_IN} (8 frames, generated)" in rows
    assert not any(name.startswith("paper") for name in rows)
    # Called again it keeps its run and packs the same zip.
    before = archive.read_bytes()
    example.main(tmp_path / "arctic", frames=8)
    with zipfile.ZipFile(io.BytesIO(before)) as old, zipfile.ZipFile(archive) as new:
        assert [i.CRC for i in old.infolist()] == [i.CRC for i in new.infolist()]


def test_reconstruct_arctic_says_what_it_needs(tmp_path: Path) -> None:
    example = load("reconstruct_arctic")
    assert example.path_of("arctic_s03_box_grab_01_1") == Path("s03/box_grab_01/1")
    with pytest.raises(InputError, match="expected names as arctic_s05_box_grab_01_1, found box"):
        example.path_of("box")
    with pytest.raises(InputError, match="expected the challenge's clip, or ARCTIC's release"):
        example.main(tmp_path / "out", data=tmp_path)


@pytest.mark.slow
def test_reconstruct_ho3d(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scores = load("reconstruct_ho3d").main(tmp_path / "ho3d", frames=16, view="limited")
    text = capsys.readouterr().out
    assert "limited: directions within" in text and "generated" in text
    assert "mpjpe_ra_l" not in scores and 0 < scores["mpjpe_ra_r"] < 40
    assert len(load_hold(tmp_path / "ho3d" / "clips" / "SYN1_limited")) == 4
    assert "SYN1_limited" in (tmp_path / "ho3d" / "comparison.md").read_text()


@pytest.mark.slow
def test_reconstruct_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example = load("reconstruct_video")
    run = example.main(tmp_path / "video")
    text = capsys.readouterr().out
    for step in ("frames", "masks", "hands", "object", "align", "build"):
        assert re.search(rf"^{step} +made: ", text, re.M), text
    clip = load_hold(tmp_path / "video" / "clip")
    assert set(clip.hands) == {"right", "left"} and clip.object is not None and len(clip) == 20
    scores = json.loads((run / "metrics.json").read_text())["result"]
    assert scores["mpjpe_ra_h"] < 25 and scores["cd_icp_sq"] < 2 and scores["psnr_foreground"] > 8
    with pytest.raises(InputError, match="expected --masks and --keypoints with a video"):
        example.main(tmp_path / "other", video=tmp_path / "video.mp4")


@pytest.mark.slow
def test_novel_pose(tmp_path: Path, finished_run: Run, tiny_clip: Path) -> None:
    """A run that follows its own clip stays near its own poses; its own clip backwards does not."""
    example = load("novel_pose")
    after = example.main(tmp_path, run=finished_run.folder, motion=tiny_clip)
    before = load_run(finished_run.folder)
    for side in ("right", "left"):
        moved = (after.hands[side].joints - before.hands[side].joints).norm(dim=-1).mean()
        crossed = (after.hands[side].joints - before.hands[side].joints.flip(0)).norm(dim=-1).mean()
        assert moved < 0.06 and moved < 0.5 * crossed
        error = torch.linalg.vector_norm(
            after.hands[side].joints[:, 0] - initial_wrists(tiny_clip, side), dim=-1
        )
        assert error.median() < 0.02
    assert len(list(tmp_path.glob("[0-9]*.png"))) == len(before)
    upper, lower = np.split(pixels(tmp_path / "strip.png"), 2, axis=0)
    assert 0.01 < np.abs(upper - lower).mean() < 0.2
    assert 0.05 < (lower < 0.95).any(axis=-1).mean() < 0.8


def initial_wrists(clip: Path, side: Side) -> torch.Tensor:
    """Where the clip's estimates have a wrist, [T, 3] in the camera."""
    return torch.from_numpy(initial_trajectory(load_hold(clip), load_hand_models(None)).joints[side][:, 0])


def test_an_example_is_a_program(tmp_path: Path) -> None:
    command = [sys.executable, EXAMPLES / "render_gaussians.py", "--out", tmp_path, "--count", "500"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "500 Gaussians" in done.stdout
    assert (tmp_path / "colors.png").is_file()

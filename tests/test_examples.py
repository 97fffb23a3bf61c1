"""The examples run as they are shown, with small settings, and make what they promise."""

from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import trimesh
from PIL import Image

from bigs.export.challenge import load_challenge

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
    assert names == {"render_gaussians", "fit_image", "pose_hand", "reconstruct_arctic", "gsplat_script"}
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


@pytest.mark.slow
def test_reconstruct_arctic(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    submission = load("reconstruct_arctic").main(tmp_path / "arctic", frames=12)
    assert submission.name == "synthetic_bottle_0.pt"
    predicted = load_challenge(submission)
    assert set(predicted.joints) == {"right", "left"} and predicted.object_verts is not None
    assert len(predicted.frame_names) == 12
    rows = {line.split("  ")[0]: line for line in capsys.readouterr().out.splitlines()}
    assert "is complete: 12 frames" in next(iter(rows))
    mpjpe = rows["MPJPE, mean of hands"].removesuffix(" %").split()
    assert float(mpjpe[-1]) < -10.0


def test_an_example_is_a_program(tmp_path: Path) -> None:
    command = [sys.executable, EXAMPLES / "render_gaussians.py", "--out", tmp_path, "--count", "500"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "500 Gaussians" in done.stdout
    assert (tmp_path / "colors.png").is_file()

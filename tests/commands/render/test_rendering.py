"""`bigs render` and `bigs export` on a finished run."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import Answer, Run, assert_refused
from PIL import Image

from bigs.commands.export.formats import FORMATS
from bigs.commands.folder.contents import load_run
from bigs.commands.render.frame import orbit_camera, render_input_view, straight_rgba
from bigs.data.base import Clip
from bigs.models.playback import Playback
from bigs.raster import rasterization

GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def playback(finished_run: Run) -> Playback:
    return load_run(finished_run.folder)


def camera_frame(clip: Clip, frame: int, world_from_cv: np.ndarray, scale: float = 1.0) -> dict[str, Any]:
    """One frame of a transforms.json: a camera in the clip's camera frame, OpenCV to OpenGL axes."""
    return {
        "file_path": "any.png",
        "frame_index": frame,
        "w": round(scale * clip.width),
        "h": round(scale * clip.height),
        "fl_x": scale * clip.K[0, 0],
        "fl_y": scale * clip.K[1, 1],
        "cx": scale * clip.K[0, 2],
        "cy": scale * clip.K[1, 2],
        "transform_matrix": (world_from_cv @ GL_FROM_CV).tolist(),
    }


@pytest.fixture
def render(
    call: Callable[..., Answer], finished_run: Run, tmp_path: Path
) -> Callable[[list[dict[str, Any]]], list[np.ndarray]]:
    def run(frames: list[dict[str, Any]]) -> list[np.ndarray]:
        file, out = tmp_path / "transforms.json", tmp_path / "pictures"
        file.write_text(json.dumps({"camera_model": "PINHOLE", "frames": frames}))
        answer = call("render", finished_run.folder, "--cameras", file, "--out", out)
        assert answer.code == 0 and answer.err == ""
        assert [path.name for path in sorted(out.iterdir())] == [f"{i:04d}.png" for i in range(len(frames))]
        pictures = [Image.open(path) for path in sorted(out.iterdir())]
        assert all(picture.mode == "RGBA" for picture in pictures)
        return [np.asarray(picture) for picture in pictures]

    return run


@pytest.mark.slow
def test_the_input_camera_shows_the_preview_again(
    render: Callable[..., list[np.ndarray]], playback: Playback, tiny: Clip
) -> None:
    frames = [7, 0]
    for t, picture in zip(frames, render([camera_frame(tiny, t, np.eye(4)) for t in frames]), strict=True):
        assert picture.shape == (tiny.height, tiny.width, 4)
        color, alpha = render_input_view(playback, t)
        np.testing.assert_allclose(picture[..., 3] / 255, alpha, atol=0.51 / 255)
        # Straight colours: over black they are the preview's, but for what light makes brighter than white.
        over_black = picture[..., :3] / 255 * alpha[..., None]
        np.testing.assert_allclose(over_black, np.minimum(color, alpha[..., None]), atol=0.51 / 255)
        # Where something is opaque, it looks like the photograph; where nothing is, nothing is shown.
        seen = tiny.mask(t) != 0
        assert (picture[..., 3][seen] > 128).mean() > 0.85
        assert np.abs(picture[..., :3][seen].astype(float) - tiny.image(t)[seen]).mean() < 50
        assert (picture[..., 3][:5, :5] == 0).all()


@pytest.mark.slow
def test_pictures_agree_with_the_slow_renderer(playback: Playback) -> None:
    color, alpha = render_input_view(playback, 4)
    views = torch.eye(4)[None], playback.K[None], playback.width, playback.height
    slow = rasterization(*playback.gaussians([4]), *views, backend="torch")
    np.testing.assert_allclose(color, slow.colors[0, 0].numpy(), atol=2e-4)
    np.testing.assert_allclose(alpha, slow.alphas[0, 0, ..., 0].numpy(), atol=2e-4)


@pytest.mark.slow
def test_a_turned_camera_shows_another_side(
    render: Callable[..., list[np.ndarray]], playback: Playback, tiny: Clip
) -> None:
    turned = np.linalg.inv(orbit_camera(playback, 3, 40.0).double().numpy())
    here, there = render([camera_frame(tiny, 3, np.eye(4)), camera_frame(tiny, 3, turned)])
    assert (there[..., 3] > 128).sum() > 0.3 * (here[..., 3] > 128).sum()
    assert np.abs(here.astype(float) - there).mean() > 5


@pytest.mark.slow
def test_moving_the_camera_right_moves_the_picture_left(
    render: Callable[..., list[np.ndarray]], tiny: Clip
) -> None:
    """OpenGL axes are turned into OpenCV's: x is right in both, y and z are not."""
    moves = {"right": (0, 0.03), "down": (1, 0.03), "near": (2, 0.1)}
    cameras = [np.eye(4)]
    for axis, distance in moves.values():
        cameras.append(np.eye(4))
        cameras[-1][axis, 3] = distance
    still, right, down, near = render([camera_frame(tiny, 2, camera) for camera in cameras])

    def middle(picture: np.ndarray) -> tuple[float, float]:
        rows, columns = np.nonzero(picture[..., 3] > 128)
        return columns.mean(), rows.mean()

    assert middle(right)[0] < middle(still)[0] - 2
    assert middle(down)[1] < middle(still)[1] - 2
    assert (near[..., 3] > 128).sum() > 1.1 * (still[..., 3] > 128).sum()


@pytest.mark.slow
def test_each_camera_has_its_own_size(render: Callable[..., list[np.ndarray]], tiny: Clip) -> None:
    small, large = render([camera_frame(tiny, 2, np.eye(4), scale) for scale in (0.5, 2.0)])
    assert small.shape == (45, 60, 4) and large.shape == (180, 240, 4)
    covered = [(picture[..., 3] > 128).mean() for picture in (small, large)]
    assert covered[0] == pytest.approx(covered[1], rel=0.15)


def test_straight_colors() -> None:
    alpha = np.array([[0.0, 0.5, 1.0, 1e-9]])
    color = np.array([[[0, 0, 0], [0.25, 0.1, 0.5], [0.2, 0.4, 1.0], [1e-9, 0, 0]]])
    rgba = straight_rgba(color, alpha)
    assert rgba.dtype == np.uint8 and rgba.shape == (1, 4, 4)
    assert rgba[0, :, 3].tolist() == [0, 128, 255, 0]
    assert rgba[0, 1, :3].tolist() == [128, 51, 255]
    assert rgba[0, 2, :3].tolist() == [51, 102, 255]


WRITTEN = {
    "ply": ["gaussians/hand.ply", "gaussians/object.ply"],
    "spz": ["gaussians/frame_0006.spz"],
    "splat-glb": ["gaussians/frame_0006.glb"],
    "glb": ["scene.glb"],
    "obj": ["meshes/frame_0006.obj"],
    "rerun": ["NAME.rrd"],
    "poses": ["poses.npz"],
    "mano": ["mano.npz"],
    "arctic": ["arctic.npz"],
    "challenge": ["arctic_preds/NAME.pt"],
    "mesh": ["meshes/object.ply"],
    "hand-meshes": [f"meshes/{side}_{t:04d}.ply" for side in ("left", "right") for t in range(12)],
}


@pytest.mark.slow
@pytest.mark.parametrize("format", FORMATS)
def test_export(
    call: Callable[..., Answer], finished_run: Run, tiny: Clip, tmp_path: Path, format: str
) -> None:
    out = tmp_path / "out"
    answer = call("export", finished_run.folder, "--format", format, "--out", out)
    assert answer.code == 0 and answer.err == ""
    written = sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())
    assert written == [name.replace("NAME", tiny.name) for name in WRITTEN[format]]
    assert str(out / written[0]) in answer.out or format == "hand-meshes"
    if format in ("ply", "poses", "challenge", "mesh"):  # those that every run has
        for name in written:
            original = (finished_run.folder / name).read_bytes()
            assert len((out / name).read_bytes()) == len(original)


@pytest.mark.parametrize("format", FORMATS)
def test_the_documentation_names_the_files(format: str) -> None:
    page = (Path(__file__).parents[3] / "docs" / "viewing.md").read_text()
    (row,) = [line for line in page.splitlines() if line.startswith(f"| `{format}` |")]
    told = re.findall("`([^`]+)`", row.split("|")[2])
    # A name without a folder lies where the first one does.
    told = [name if "/" in name else str(Path(told[0]).parent / name) for name in told]
    assert {re.sub(r"\d{4}", "0000", name) for name in WRITTEN[format]} <= set(told)


@pytest.mark.slow
def test_formats_add_up(call: Callable[..., Answer], finished_run: Run, tmp_path: Path) -> None:
    command = ("export", finished_run.folder, "--out", tmp_path)
    answer = call(*command, "--format", "ply", "--format", "glb", "--format", "ply")
    assert (answer.code, answer.err) == (0, "")
    names = [*WRITTEN["ply"], *WRITTEN["glb"]]
    assert answer.out.split() == [str(tmp_path / name) for name in names]
    assert all((tmp_path / name).is_file() for name in names)


@pytest.mark.slow
def test_nothing_is_written_if_one_format_cannot_be(
    call: Callable[..., Answer], finished_run: Run, tmp_path: Path
) -> None:
    command = ("export", finished_run.folder, "--out", tmp_path)
    answer = call(*command, "--format", "ply", "--format", "glb", "--frames", "1")
    assert_refused(answer, "frames", "ply, spz", "found glb")
    assert_refused(call(*command), "--format", "ply, spz", "found none")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_exported_hands_are_the_scenes(
    call: Callable[..., Answer], finished_run: Run, playback: Playback, tmp_path: Path
) -> None:
    trimesh = pytest.importorskip("trimesh")
    call("export", finished_run.folder, "--format", "hand-meshes", "--out", tmp_path)
    for side in ("right", "left"):
        mesh = trimesh.load_mesh(tmp_path / "meshes" / f"{side}_0007.ply", process=False)
        np.testing.assert_allclose(mesh.vertices, playback.hands[side].verts[7].numpy(), atol=1e-6)
        assert mesh.is_watertight and mesh.volume > 0

"""`bigs render` without a file of cameras, with other programs' files, and what it writes beside pictures."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import Answer, Run, assert_refused
from PIL import Image

from bigs.commands.folder.contents import load_run
from bigs.commands.render.frame import render_depth, render_frame, render_input_view, straight_rgba
from bigs.commands.render.views import Shot, Wanted, background_of, over, render_run, views_of
from bigs.models.playback import Playback

pytestmark = pytest.mark.slow

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def playback(finished_run: Run) -> Playback:
    return load_run(finished_run.folder)


def test_from_input_is_the_clips_own_view(
    call: Callable[..., Answer], finished_run: Run, playback: Playback, tmp_path: Path
) -> None:
    answer = call("render", finished_run.folder, "--from-input", "--out", tmp_path / "out")
    assert (answer.code, answer.out, answer.err) == (0, f"12 pictures in {tmp_path / 'out'}\n", "")
    pictures = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in pictures] == [f"{t:04d}.png" for t in range(12)]
    for t in (0, 11):
        shown = np.asarray(Image.open(pictures[t]))
        np.testing.assert_array_equal(shown, straight_rgba(*render_input_view(playback, t)))


def test_an_orbit_turns_about_the_object_and_ends_where_it_began(playback: Playback) -> None:
    cameras, fps = views_of(playback, Shot(orbit=True, frame=4, pictures=8))
    assert fps is None and {camera.frame_index for camera in cameras} == {4}
    np.testing.assert_allclose(cameras[0].viewmat, np.eye(4), atol=1e-6)
    middle = playback.gaussians([4], ["object"]).means[0].median(0).values.double().numpy()
    places = []
    for camera in cameras:
        np.testing.assert_allclose(camera.viewmat[:3, :3] @ middle + camera.viewmat[:3, 3], middle, atol=1e-6)
        places.append(np.linalg.inv(camera.viewmat)[:3, 3])
    # Half a turn later the camera looks from behind, and its steps are even and all around.
    np.testing.assert_allclose(places[4], [2 * middle[0], 0, 2 * middle[2]], atol=1e-5)
    steps = [np.linalg.norm(a - b) for a, b in zip(places, [*places[1:], places[0]], strict=True)]
    np.testing.assert_allclose(steps, steps[0], rtol=1e-4)


def test_an_orbit_that_plays_shows_every_frame_and_one_place(playback: Playback) -> None:
    cameras, _ = views_of(playback, Shot(orbit=True, play=True))
    assert [camera.frame_index for camera in cameras] == list(range(12))
    more, _ = views_of(playback, Shot(orbit=True, play=True, pictures=14, about="scene"))
    assert [camera.frame_index for camera in more] == [*range(12), 0, 1]
    still, _ = views_of(playback, Shot(orbit=True))
    assert len(still) == 120 and {camera.frame_index for camera in still} == {6}


def test_another_size_keeps_the_vertical_angle(playback: Playback) -> None:
    (own,), _ = views_of(playback, Shot(from_input=True, frame=0))
    (wide,), _ = views_of(playback, Shot(from_input=True, frame=0, size=(400, 180)))
    assert (wide.width, wide.height) == (400, 180)
    np.testing.assert_allclose(wide.K[1] / 180, own.K[1] / playback.height)
    assert wide.K[0, 0] / wide.K[1, 1] == pytest.approx(own.K[0, 0] / own.K[1, 1])
    # What was in the middle stays in the middle.
    assert wide.K[0, 2] - 200 == pytest.approx(2 * (own.K[0, 2] - playback.width / 2))


def cameras_file(folder: Path, **fields: Any) -> Path:
    """The clip's own view, as Blender's exporters write a camera."""
    file = folder / "cameras.json"
    document = {"camera_angle_x": 0.8, "frames": [{"transform_matrix": FLIP.tolist()}] * 3} | fields
    file.write_text(json.dumps(document))
    return file


def test_a_file_without_times_gets_them(playback: Playback, tmp_path: Path) -> None:
    file = cameras_file(tmp_path)
    at_rest, _ = views_of(playback, Shot(cameras=file, frame=5))
    assert [camera.frame_index for camera in at_rest] == [5, 5, 5]
    playing, _ = views_of(playback, Shot(cameras=file, play=True, size=(50, 40)))
    assert [(c.frame_index, c.width, c.height) for c in playing] == [(0, 50, 40), (1, 50, 40), (2, 50, 40)]
    np.testing.assert_allclose(playing[0].viewmat, np.eye(4))
    assert at_rest[0].K[0, 0] == pytest.approx(60 / np.tan(0.4)) and at_rest[0].height == playback.height


def test_in_the_objects_world_the_object_stands_still(playback: Playback, tmp_path: Path) -> None:
    far = FLIP.copy()
    far[2, 3] = -0.6  # OpenGL axes turned to look along +z, from 60 cm in front of the object's origin
    file = cameras_file(tmp_path, frames=[{"transform_matrix": far.tolist()}] * 2)
    cameras, _ = views_of(playback, Shot(cameras=file, play=True, world="object"))
    seen = []
    for camera in cameras:
        points = playback.gaussians([camera.frame_index], ["object"]).means[0].double().numpy()
        seen.append(points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])
    np.testing.assert_allclose(seen[0], seen[1], atol=1e-5)
    assert playback.object is not None
    own = (playback.object.scale * playback.object.splats.means).numpy()
    np.testing.assert_allclose(seen[0], own + np.array([0, 0, 0.6]), atol=1e-5)


def test_a_background_lies_behind_everything(finished_run: Run, playback: Playback, tmp_path: Path) -> None:
    shot = Shot(from_input=True, frame=7)
    (path,) = render_run(finished_run.folder, shot, Wanted(tmp_path, background=(255, 128, 0)))
    picture = Image.open(path)
    color, alpha = render_input_view(playback, 7)
    assert picture.mode == "RGB" and np.asarray(picture)[0, 0].tolist() == [255, 128, 0]
    expected = 255 * color + (1 - alpha[..., None]) * np.array([255, 128, 0])
    np.testing.assert_allclose(np.asarray(picture), expected.clip(0, 255), atol=0.51)


def test_depth_is_in_millimetres_or_metres(finished_run: Run, playback: Playback, tmp_path: Path) -> None:
    shot = Shot(from_input=True, frame=3)
    color, png = render_run(finished_run.folder, shot, Wanted(tmp_path / "a", depth="png"))
    _, npy = render_run(finished_run.folder, shot, Wanted(tmp_path / "b", depth="npy"))
    assert (color.name, png, npy) == (
        "0000.png",
        tmp_path / "a" / "depth" / "0000.png",
        tmp_path / "b" / "depth" / "0000.npy",
    )
    millimetres, metres = np.asarray(Image.open(png)), np.load(npy)
    assert millimetres.dtype == np.uint16 and metres.dtype == np.float32
    np.testing.assert_allclose(millimetres, 1000.0 * metres, atol=0.51)
    # It is where the surface is: as far as the meshes are, within a centimetre or so.
    _, alpha = render_input_view(playback, 3)
    assert ((metres > 0) == (alpha > 0.5)).all()
    depths = playback.gaussians([3]).means[0, :, 2].numpy()
    assert depths.min() - 0.02 < metres[metres > 0].min() and metres.max() < depths.max() + 0.02


def test_depth_of_a_wall_is_its_distance(playback: Playback) -> None:
    """Moving the camera back by a known way adds that way."""
    near = render_depth(playback, 2, torch.eye(4), playback.K, playback.width, playback.height)
    back = torch.eye(4)
    back[2, 3] = 0.25
    K = playback.K.clone()
    middle = float(np.median(near[near > 0]))
    K[0, 0], K[1, 1] = (K[i, i] * (middle + 0.25) / middle for i in (0, 1))
    far = render_depth(playback, 2, back, K, playback.width, playback.height)
    both = (near > 0) & (far > 0)
    assert np.median(far[both] - near[both]) == pytest.approx(0.25, abs=0.01)


def test_a_video_of_a_camera_path(
    call: Callable[..., Answer], finished_run: Run, playback: Playback, tmp_path: Path
) -> None:
    av = pytest.importorskip("av", reason="needs the extra 'video'")
    entry = {"camera_to_world": FLIP.ravel().tolist(), "fov": 50.0, "aspect": 4 / 3}
    document = {"render_width": 64, "render_height": 48, "fps": 12, "seconds": 0.25}
    file, video = tmp_path / "path.json", tmp_path / "videos" / "turn.mp4"
    file.write_text(json.dumps(document | {"camera_path": [entry] * 3}))
    command = ("render", finished_run.folder, "--cameras", file, "--play", "--background", "white")
    answer = call(*command, "--video", video)
    assert (answer.code, answer.out, answer.err) == (0, f"{video}\n", "")
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height, stream.average_rate) == (64, 48, 12)
        shown = [frame.to_ndarray(format="rgb24").astype(float) for frame in container.decode(stream)]
    (_, second, _), _ = views_of(playback, Shot(cameras=file, play=True))
    matrices = (torch.as_tensor(x, dtype=torch.float32) for x in (second.viewmat, second.K))
    color, alpha = render_frame(playback, 1, *matrices, 64, 48)
    assert len(shown) == 3 and shown[0][:4, :4].min() > 245
    assert np.abs(shown[1] - 255 * over(color, alpha, (255, 255, 255)).clip(0, 1)).mean() < 5


def test_cameras_of_two_sizes_make_no_video(finished_run: Run, tmp_path: Path) -> None:
    matrix = {"transform_matrix": FLIP.tolist()}
    file = cameras_file(tmp_path, frames=[{**matrix, "w": 40, "h": 30}, {**matrix, "w": 80, "h": 60}])
    command = Shot(cameras=file, frame=0), Wanted(video=tmp_path / "a.mp4")
    with pytest.raises(ValueError, match="--video: expected cameras of one size, found 40 x 30 and 80 x 60"):
        render_run(finished_run.folder, *command)
    assert not (tmp_path / "a.mp4").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--out", "x"], ["cameras", "--cameras FILE, --orbit and --from-input", "found none"]),
        (["--orbit", "--from-input", "--out", "x"], ["found --orbit and --from-input"]),
        (["--orbit"], ["--out DIR", "--video FILE.mp4", "found neither"]),
        (["--orbit", "--out", "x", "--frame", "12"], ["--frame", "0 to 11", "12"]),
        (["--orbit", "--out", "x", "--frame", "2", "--play"], ["--play", "this or --frame", "both"]),
        (["--from-input", "--out", "x", "--pictures", "9"], ["--pictures 9", "--orbit", "--from-input"]),
        (["--from-input", "--out", "x", "--about", "scene"], ["--about scene", "--orbit", "--from-input"]),
        (["--orbit", "--out", "x", "--world", "object"], ["--world object", "--cameras", "--orbit"]),
        (["--orbit", "--out", "x", "--pictures", "0"], ["--pictures", "1 to 10000", "0"]),
        (["--orbit", "--out", "x", "--size", "0", "5"], ["--size", "positive", "0 5"]),
        (["--orbit", "--out", "x", "--size", "9999", "9999"], ["--size", "33177600 pixels", "9999 x 9999"]),
        (["--orbit", "--video", "x.avi"], ["--video", ".mp4", "x.avi"]),
        (["--orbit", "--video", "x.mp4", "--depth", "png"], ["--depth", "--out DIR", "none"]),
        (["--orbit", "--out", "x", "--background", "1,2"], ["--background", "R,G,B", "'1,2'"]),
    ],
)
def test_what_does_not_go_together(
    call: Callable[..., Answer], finished_run: Run, options: list[str], words: list[str]
) -> None:
    assert_refused(call("render", finished_run.folder, *options), *words)


def test_names_of_backgrounds() -> None:
    assert background_of("transparent") is None
    assert background_of("white") == (255, 255, 255) and background_of("black") == (0, 0, 0)
    assert background_of("1,20,255") == (1, 20, 255)
    for wrong in ("red", "", "256,0,0", "1,2,3,4", "-1,0,0", "1.5,0,0", "１,2,3"):
        with pytest.raises(ValueError, match="--background"):
            background_of(wrong)

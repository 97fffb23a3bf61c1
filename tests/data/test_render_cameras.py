"""Files of cameras: OpenGL cameras in, OpenCV cameras out, and strict about everything else."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bigs.checks import InputError
from bigs.data.formats.transforms import MOST_CAMERAS, RenderCamera, write_transforms
from bigs.data.render_cameras import load_cameras

IDENTITY = np.eye(4).tolist()


def document(**changes: Any) -> dict[str, Any]:
    base: dict[str, Any] = {"fl_x": 100.0, "fl_y": 90.0, "cx": 33.0, "cy": 22.0, "w": 64, "h": 48}
    base["frames"] = [{"frame_index": 2, "transform_matrix": IDENTITY}]
    return {key: value for key, value in (base | changes).items() if value is not None}


def load(tmp_path: Path, content: Any, **options: Any) -> list[RenderCamera]:
    file = tmp_path / "transforms.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    return load_cameras(file, **{"frame_count": 5} | options).cameras


def test_an_opengl_camera_sees_what_lies_along_its_negative_z(tmp_path: Path) -> None:
    # The camera stands at (1, 2, 3), its x axis is the world's, its y axis (up) the world's z, and so it
    # looks along its own -z, which is the world's +y.
    matrix = [[1, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
    frame = {"frame_index": 0, "transform_matrix": matrix}
    (camera,) = load(tmp_path, document(frames=[frame]))
    ahead_right_and_up = np.array([1 + 0.4, 2 + 2.0, 3 + 0.6, 1.0])
    in_camera = camera.viewmat @ ahead_right_and_up
    np.testing.assert_allclose(in_camera, [0.4, -0.6, 2.0, 1.0], atol=1e-12)
    u, v, depth = camera.K @ in_camera[:3]
    assert (u / depth, v / depth) == pytest.approx((33 + 100 * 0.2, 22 - 90 * 0.3))


def test_the_clips_own_camera_is_a_flip(tmp_path: Path) -> None:
    # World is the clip's OpenCV camera; seen from there, OpenGL axes are y and z reversed.
    flip = np.diag([1.0, -1.0, -1.0, 1.0]).tolist()
    (camera,) = load(tmp_path, document(frames=[{"frame_index": 0, "transform_matrix": flip}]))
    np.testing.assert_array_equal(camera.viewmat, np.eye(4))


def test_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    cameras = []
    for index in range(4):
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
        K = np.array([[80.0 + index, 0, 20], [0, 70.0, 30], [0, 0, 1]])
        cameras.append(RenderCamera(3 - index, viewmat, K, 40 + index, 60))
    write_transforms(tmp_path / "t.json", cameras)
    loaded = load_cameras(tmp_path / "t.json", frame_count=4).cameras
    for a, b in zip(cameras, loaded, strict=True):
        assert (a.frame_index, a.width, a.height) == (b.frame_index, b.width, b.height)
        np.testing.assert_allclose(a.viewmat, b.viewmat, atol=1e-12)
        np.testing.assert_array_equal(a.K, b.K)


def test_a_frame_overrides_the_file(tmp_path: Path) -> None:
    frames = [
        {"frame_index": 0, "transform_matrix": IDENTITY},
        {"frame_index": 1, "transform_matrix": IDENTITY, "fl_x": 50, "w": 32, "cx": 10.5},
    ]
    first, second = load(tmp_path, document(frames=frames))
    assert (first.K[0, 0], first.K[0, 2], first.width) == (100, 33, 64)
    assert (second.K[0, 0], second.K[0, 2], second.width, second.K[1, 1]) == (50, 10.5, 32, 90)


def test_field_of_view_and_middle_as_fallback(tmp_path: Path) -> None:
    content = document(fl_x=None, fl_y=None, cx=None, cy=None, camera_angle_x=math.pi / 2, w=64.0)
    (camera,) = load(tmp_path, content)
    np.testing.assert_allclose(camera.K, [[32, 0, 32], [0, 32, 24], [0, 0, 1]])
    (camera,) = load(tmp_path, document(fl_y=None))
    assert camera.K[1, 1] == camera.K[0, 0] == 100


def test_zero_distortion_and_unknown_fields_are_fine(tmp_path: Path) -> None:
    assert load(tmp_path, document(k1=0.0, p2=0, aabb_scale=16, camera_model="OPENCV"))


def frame(**changes: Any) -> dict[str, Any]:
    base: dict[str, Any] = {"frame_index": 2, "transform_matrix": IDENTITY}
    entry = {key: value for key, value in (base | changes).items() if value is not None}
    return document(frames=[entry])


SCALED = (2 * np.eye(4)).tolist()
MIRRORED = np.diag([-1.0, 1, 1, 1]).tolist()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "JSON"),
        ("[1]", "dictionary.*list"),
        (document(frames=None), "frames.*w, h"),
        (document(frames=[]), r"frames.*\[\]"),
        (document(frames=[3]), r"frames\[0\].*int"),
        (document(w=None), r"frames\[0\]\.w"),
        (document(h=0), r"frames\[0\]\.h.*0"),
        (document(w=64.5), "whole number.*64.5"),
        (document(w="64"), "w: expected .*number.*found str"),
        (document(fl_x=None), "fl_x or camera_angle_x"),
        (document(fl_x=0), "fl_x.*positive.*0"),
        (document(fl_x=None, camera_angle_x=4.0), "camera_angle_x.*pi"),
        (document(cx=float("nan")), "cx.*nan"),
        (document(k1=0.1), "k1.*distortion.*0.1"),
        (document(camera_model="OPENCV_FISHEYE"), "camera_model.*FISHEYE"),
        (frame(frame_index=None), "frame_index: expected this field, or .*--frame N or --play"),
        (
            document(w=16384, h=16384),
            r"frames\[0\]\.w: expected at most 33177600 pixels, found 16384 x 16384",
        ),
        (document(frames=[3] * (MOST_CAMERAS + 1)), "frames: expected at most 10000 cameras, found 10001"),
        (frame(frame_index=-1), "frame_index.*-1"),
        (frame(frame_index=1.5), "frame_index.*1.5"),
        (frame(frame_index=True), "frame_index.*True"),
        (frame(frame_index=9), "frame_index.*at most 4.*9"),
        (frame(transform_matrix=None), "transform_matrix"),
        (frame(transform_matrix=IDENTITY[:3]), r"transform_matrix.*\[4, 4\].*\[3, 4\]"),
        (frame(transform_matrix=[[1], [1, 2]]), "transform_matrix.*4 x 4"),
        (frame(transform_matrix=[["a"] * 4] * 4), "transform_matrix.*numbers"),
        (frame(transform_matrix=SCALED), "transform_matrix.*rigid"),
        (frame(transform_matrix=MIRRORED), "transform_matrix.*rigid"),
    ],
)
def test_what_is_wrong(tmp_path: Path, content: Any, words: str) -> None:
    with pytest.raises(InputError, match=rf"transforms\.json: .*{words}") as caught:
        load(tmp_path, content)
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found no such file"):
        load_cameras(tmp_path / "none.json", frame_count=5)


BLENDER = {
    "camera_angle_x": math.pi / 2,
    "frames": [
        {"file_path": f"./train/r_{i}", "rotation": 0.01, "transform_matrix": IDENTITY} for i in (0, 1)
    ],
}


def test_blenders_cameras_get_size_and_time(tmp_path: Path) -> None:
    cameras = load(tmp_path, BLENDER, size=(80, 60), time_of=lambda index: 4 - index)
    assert [camera.frame_index for camera in cameras] == [4, 3]
    for camera in cameras:
        assert (camera.width, camera.height) == (80, 60)
        np.testing.assert_allclose(camera.K, [[40, 0, 40], [0, 40, 30], [0, 0, 1]])


def test_a_time_is_not_given_twice(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"frames\[0\]\.frame_index: expected none beside --frame or --play"):
        load(tmp_path, document(), time_of=lambda index: 0)


# OpenGL axes: one step to the right of the world's origin, turned by a quarter to look along +x.
LOOKS_ALONG_X = [0, 0, -1, 1, 0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1]


def camera_path(**changes: Any) -> dict[str, Any]:
    """As nerfstudio's viewer saves it."""
    entry = {"camera_to_world": LOOKS_ALONG_X, "fov": 90.0, "aspect": 1.5}
    base: dict[str, Any] = {
        "camera_type": "perspective",
        "render_height": 40,
        "render_width": 60,
        "fps": 24,
        "seconds": 0.5,
        "is_cycle": False,
        "keyframes": [],
        "camera_path": [entry],
    }
    of_camera = {key: value for key, value in changes.items() if key in entry}
    if of_camera:
        base["camera_path"] = [{k: v for k, v in {**entry, **of_camera}.items() if v is not None}]
        changes = {key: value for key, value in changes.items() if key not in entry}
    return {key: value for key, value in (base | changes).items() if value is not None}


def test_a_camera_path_of_nerfstudios_viewer(tmp_path: Path) -> None:
    file = tmp_path / "path.json"
    file.write_text(json.dumps(camera_path()))
    found = load_cameras(file, frame_count=5, time_of=lambda index: 2)
    (camera,) = found.cameras
    assert found.fps == 24 and (camera.frame_index, camera.width, camera.height) == (2, 60, 40)
    # The angle is the vertical one: 20 pixels up and 20 pixels away.
    np.testing.assert_allclose(camera.K, [[20, 0, 30], [0, 20, 20], [0, 0, 1]])
    # A point ahead, up, and to the right, which is the world's +z.
    np.testing.assert_allclose(camera.viewmat @ [3.0, 0.5, 0.25, 1.0], [0.25, -0.5, 2.0, 1.0], atol=1e-12)
    (sized,) = load(tmp_path, camera_path(render_height=None, render_width=None), size=(30, 20), time_of=int)
    assert sized.K[1, 1] == pytest.approx(10) and (sized.width, sized.height) == (30, 20)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (camera_path(camera_type="equirectangular"), "camera_type: expected perspective, found 'equirect"),
        (camera_path(camera_path=[]), "camera_path: expected a list of cameras"),
        (camera_path(camera_path=[1]), r"camera_path\[0\]: expected a dictionary, found int"),
        (camera_path(camera_path=[1] * 10_001), "camera_path: expected at most 10000 cameras, found 10001"),
        (camera_path(camera_to_world=[1.0] * 12), r"\[0\]\.camera_to_world: expected a list of 16.*found 12"),
        (camera_path(camera_to_world=[2.0] * 16), r"\[0\]\.camera_to_world: expected a rigid motion"),
        (camera_path(camera_to_world=None), r"\[0\]\.camera_to_world: expected this field"),
        (camera_path(fov=None), r"\[0\]\.fov: expected this field"),
        (camera_path(fov=180), r"\[0\]\.fov: expected degrees between 0 and 180, found 180"),
        (camera_path(fov="wide"), r"\[0\]\.fov: expected .*number.*found str"),
        (camera_path(fps=0), "fps: expected a positive number, found 0"),
        (camera_path(render_width=99999999), "expected at most 33177600 pixels, found 99999999 x 40"),
        (camera_path(render_width=None), "render_width: expected this field"),
    ],
)
def test_what_is_wrong_with_a_camera_path(tmp_path: Path, content: Any, words: str) -> None:
    with pytest.raises(InputError, match=rf"transforms\.json: .*{words}") as caught:
        load(tmp_path, content, time_of=lambda index: 0, size=(64, 48))
    assert "\n" not in str(caught.value)

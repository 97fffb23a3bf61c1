"""`transforms.json`: OpenGL cameras in, OpenCV cameras out, and strict about everything else."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bigs.checks import InputError
from bigs.data.transforms import RenderCamera, load_transforms, write_transforms

IDENTITY = np.eye(4).tolist()


def document(**changes: Any) -> dict[str, Any]:
    base: dict[str, Any] = {"fl_x": 100.0, "fl_y": 90.0, "cx": 33.0, "cy": 22.0, "w": 64, "h": 48}
    base["frames"] = [{"frame_index": 2, "transform_matrix": IDENTITY}]
    return {key: value for key, value in (base | changes).items() if value is not None}


def load(tmp_path: Path, content: Any, **options: Any) -> list[RenderCamera]:
    file = tmp_path / "transforms.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    return load_transforms(file, **options)


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
    loaded = load_transforms(tmp_path / "t.json", frame_count=4)
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
        (document(w="64"), 'w: expected a number, found "64"'),
        (document(fl_x=None), "fl_x or camera_angle_x"),
        (document(fl_x=0), "fl_x.*positive.*0"),
        (document(fl_x=None, camera_angle_x=4.0), "camera_angle_x.*pi"),
        (document(cx=float("nan")), "cx.*NaN"),
        (document(k1=0.1), "k1.*distortion.*0.1"),
        (document(camera_model="OPENCV_FISHEYE"), "camera_model.*FISHEYE"),
        (frame(frame_index=None), "frame_index"),
        (frame(frame_index=-1), "frame_index.*-1"),
        (frame(frame_index=1.5), "frame_index.*1.5"),
        (frame(frame_index=True), "frame_index.*true"),
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
        load(tmp_path, content, frame_count=5)
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_transforms(tmp_path / "none.json")

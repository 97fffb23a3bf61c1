"""Keypoint files of any detector, in either order, by name or by place."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_artefacts import FRAME_SET

from bigs.checks import InputError
from bigs.preprocess.hands.keypoints import read_keypoints, write_keypoints

# Each point says which joint it is: x is the number of the joint in MANO's order.
MANO_X = list(range(21))
OPENPOSE_X = [0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20]


def hand(order: list[int], confidence: float = 0.9) -> list[list[float]]:
    return [[x, 5.0, confidence] for x in order]


def write(folder: Path, content: dict[str, Any]) -> Path:
    file = folder / "keypoints.json"
    file.write_text(json.dumps(content))
    return file


@pytest.mark.parametrize(("order", "numbers"), [("mano", MANO_X), ("openpose", OPENPOSE_X)])
def test_both_orders_come_out_as_the_hand_model_has_them(
    tmp_path: Path, order: str, numbers: list[int]
) -> None:
    file = write(tmp_path, {"order": order, "frames": [{"right": hand(numbers)}, {"right": None}]})
    found = read_keypoints(file, FRAME_SET)
    assert found.keys() == {"right"}
    assert found["right"].points[0, :, 0].tolist() == MANO_X
    assert found["right"].confidence[0].min() == 0.9 and found["right"].confidence[1].max() == 0.0


def test_names_decide_before_order(tmp_path: Path) -> None:
    frames = {"b.png": {"left": hand(MANO_X, 0.2)}, "a.png": {"left": hand(MANO_X, 0.1)}, "z.png": {}}
    found = read_keypoints(write(tmp_path, {"order": "mano", "frames": frames}), FRAME_SET)
    assert found["left"].confidence[:, 0].tolist() == [0.1, 0.2]


def test_a_frame_that_is_not_named_has_no_hand(tmp_path: Path) -> None:
    file = write(tmp_path, {"order": "mano", "frames": {"b.png": {"left": hand(MANO_X)}}})
    assert read_keypoints(file, FRAME_SET)["left"].confidence[:, 0].tolist() == [0.0, 0.9]


def test_keypoints_of_the_whole_video_are_thinned_like_its_frames(tmp_path: Path) -> None:
    frames = replace(FRAME_SET, source_frames=(1, 3), source_length=5)
    rows = [{"right": hand(MANO_X, t / 10)} for t in range(5)]
    found = read_keypoints(write(tmp_path, {"order": "mano", "frames": rows}), frames)
    assert found["right"].confidence[:, 0].tolist() == [0.1, 0.3]


def test_another_image_size_and_pixel_centre(tmp_path: Path) -> None:
    content = {"order": "mano", "frames": [{"right": hand(MANO_X)}, {}], "pixel_center": 0.0}
    half = read_keypoints(write(tmp_path, content | {"width": 128, "height": 96}), FRAME_SET)
    assert np.allclose(half["right"].points[0, 3], [(3 + 0.5) / 2, 5.5 / 2])
    shrunk = replace(FRAME_SET, source_size=(128, 96))
    assert np.allclose(read_keypoints(write(tmp_path, content), shrunk)["right"].points[0, 3], [1.75, 2.75])


def test_missing_joints_may_be_null_or_nan(tmp_path: Path) -> None:
    points: list[Any] = hand(MANO_X)
    points[4], points[5] = None, [float("nan"), 1.0, 0.5]
    file = write(tmp_path, {"order": "mano", "frames": [{"right": points}, {}]})
    assert np.flatnonzero(read_keypoints(file, FRAME_SET)["right"].confidence[0] == 0).tolist() == [4, 5]


def test_what_is_written_is_read(tmp_path: Path) -> None:
    file = write(tmp_path, {"order": "openpose", "frames": [{"right": hand(OPENPOSE_X)}, {}]})
    first = read_keypoints(file, FRAME_SET)
    write_keypoints(file, first, FRAME_SET)
    again = read_keypoints(file, FRAME_SET)
    assert np.array_equal(again["right"].points, first["right"].points)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"frames": []}, "order: expected this field"),
        ({"order": "coco", "frames": []}, "expected one of openpose, mano, found 'coco'"),
        ({"order": "mano", "frames": [{}, {}]}, "expected keypoints of a right or left hand, found none"),
        ({"order": "mano", "frames": [{}, {}, {}]}, "expected 2 (one for each frame)"),
        ({"order": "mano", "frames": [{"right": [[1, 2, 3]]}, {}]}, "frames.0.right: expected shape [21, 3]"),
        ({"order": "mano", "frames": [{"right": "x"}, {}]}, "frames.0.right: expected"),
        ({"order": "mano", "frames": 3}, "expected a list or a dictionary, found int"),
        ({"order": "mano", "frames": [{}, {}], "width": 100, "height": 20}, "expected the proportions"),
    ],
)
def test_a_bad_file_is_told_in_a_sentence(tmp_path: Path, content: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError) as caught:
        read_keypoints(write(tmp_path, content), FRAME_SET)
    assert words in str(caught.value) and "keypoints.json" in str(caught.value)

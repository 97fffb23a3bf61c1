"""MediaPipe's detector as an optional part, shown with a stand-in of its interface."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from bigs.checks import InputError
from bigs.preprocess.hands.landmarker import find_keypoints

T = 3


def hand(label: str, score: float, x: float) -> tuple[Any, Any]:
    marks = [SimpleNamespace(x=x, y=j / 100) for j in range(21)]
    return marks, [SimpleNamespace(category_name=label, score=score)]


class StandIn:
    """What `mediapipe` offers, as far as it is used; answers with the `hands` of each frame."""

    def __init__(self, hands: list[list[tuple[Any, Any]]]) -> None:
        self.hands, self.times, self.options = hands, [], None

    def modules(self) -> dict[str, ModuleType]:
        outer = self

        class Detector:
            @classmethod
            def create_from_options(cls, options: Any) -> Detector:
                outer.options = options
                return cls()

            def __enter__(self) -> Detector:
                return self

            def __exit__(self, *exc: object) -> None:
                return None

            def detect_for_video(self, image: Any, time: int) -> Any:
                assert image.data.shape == (40, 50, 3) and image.data.dtype == np.uint8
                found = outer.hands[len(outer.times)]
                outer.times.append(time)
                return SimpleNamespace(hand_landmarks=[m for m, _ in found], handedness=[h for _, h in found])

        main, tasks, python, vision = (
            ModuleType(name)
            for name in (
                "mediapipe",
                "mediapipe.tasks",
                "mediapipe.tasks.python",
                "mediapipe.tasks.python.vision",
            )
        )
        main.Image = lambda image_format, data: SimpleNamespace(data=data)  # type: ignore[attr-defined]
        main.ImageFormat = SimpleNamespace(SRGB=1)  # type: ignore[attr-defined]
        python.BaseOptions = lambda model_asset_path: model_asset_path  # type: ignore[attr-defined]
        vision.HandLandmarkerOptions = lambda **options: SimpleNamespace(**options)  # type: ignore[attr-defined]
        vision.RunningMode = SimpleNamespace(VIDEO="video")  # type: ignore[attr-defined]
        vision.HandLandmarker = Detector  # type: ignore[attr-defined]
        main.tasks, tasks.python, python.vision = tasks, python, vision  # type: ignore[attr-defined]
        return {module.__name__: module for module in (main, tasks, python, vision)}


@pytest.fixture
def images(tmp_path: Path) -> list[Path]:
    files = [tmp_path / f"{t}.png" for t in range(T)]
    for file in files:
        Image.fromarray(np.zeros((40, 50, 3), np.uint8)).save(file)
    (tmp_path / "hand.task").write_bytes(b"model")
    return files


def install(monkeypatch: pytest.MonkeyPatch, hands: list[list[tuple[Any, Any]]]) -> StandIn:
    found = StandIn(hands)
    for name, module in found.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    return found


def test_hands_come_out_on_their_own_sides(
    images: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = [hand("Left", 0.9, 0.2), hand("Right", 0.8, 0.6)]
    twice = [hand("Left", 0.7, 0.6), hand("Left", 0.95, 0.2)]
    stand_in = install(monkeypatch, [both, [], twice])
    found = find_keypoints(tmp_path / "hand.task", images, fps=25.0)
    # It thinks that it looks into a mirror: its left is the right hand.
    assert found["right"].confidence[:, 0].tolist() == [0.9, 0.0, 0.95]
    assert found["left"].confidence[:, 0].tolist() == [0.8, 0.0, 0.7]
    assert np.allclose(found["right"].points[0, :, 0], 10.0) and np.allclose(
        found["left"].points[2, :, 0], 30.0
    )
    # Its fourth point is the thumb's tip, MANO's joint order has that at 16.
    assert np.allclose(found["right"].points[0, 16, 1], 0.04 * 40)
    assert stand_in.times == [0, 40, 80] and stand_in.options.num_hands == 2


def test_no_hand_no_file_no_mediapipe(
    images: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(
        InputError, match=r"none\.task: expected the model file of MediaPipe's HandLandmarker"
    ):
        find_keypoints(tmp_path / "none.task", images, 30.0)
    monkeypatch.setitem(sys.modules, "mediapipe", None)
    with pytest.raises(InputError, match="pip install mediapipe"):
        find_keypoints(tmp_path / "hand.task", images, 30.0)
    install(monkeypatch, [[], [], []])
    with pytest.raises(InputError, match="expected a hand in the pictures, found none in 3 frames"):
        find_keypoints(tmp_path / "hand.task", images, 30.0)

"""Keypoints by MediaPipe's HandLandmarker, where it is installed and the user has its model file.

MediaPipe is no dependency: it brings an OpenCV of its own. Install it beside, or run it elsewhere and
write the keypoints as JSON.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bigs.checks import InputError
from bigs.data.images import read_image
from bigs.preprocess.hands.keypoints import JOINTS, ORDERS, Keypoints
from bigs.types import Side

# MediaPipe assumes mirrored pictures, as of a person who looks at themselves.
_SIDE_OF: dict[str, Side] = {"Left": "right", "Right": "left"}


def find_keypoints(
    model_file: Path,
    images: Sequence[Path],
    fps: float,
    listen: Callable[[str], None] = lambda text: None,
) -> dict[Side, Keypoints]:
    """Run the detector over a clip.

    Args:
        model_file: HandLandmarker's .task file.
        images: T frames.
        fps: frames a second; its tracker wants times.
        listen: told how far it is.

    Raises:
        InputError: MediaPipe is not installed, the file is missing or no such model, or no hand was found.
    """
    if not model_file.is_file():
        raise InputError(
            f"{model_file}: expected the model file of MediaPipe's HandLandmarker (.task), found no such file"
        )
    try:
        import mediapipe
        from mediapipe.tasks import python as tasks
        from mediapipe.tasks.python import vision
    except ImportError:
        raise InputError(
            f"{model_file}: expected MediaPipe (pip install mediapipe, in an environment of its own) to "
            f"run it, "
            "found none; or give --keypoints FILE"
        ) from None
    options = vision.HandLandmarkerOptions(
        base_options=tasks.BaseOptions(model_asset_path=str(model_file)),
        running_mode=vision.RunningMode.VIDEO,
        num_hands=2,
    )
    frames = len(images)
    points: dict[Side, np.ndarray] = {side: np.zeros((frames, JOINTS, 2)) for side in ("right", "left")}
    confidence: dict[Side, np.ndarray] = {side: np.zeros((frames, JOINTS)) for side in ("right", "left")}
    try:
        with vision.HandLandmarker.create_from_options(options) as detector:
            for t, path in enumerate(images):
                pixels = read_image(path)
                picture = mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=pixels)
                result = detector.detect_for_video(picture, round(1000.0 * t / fps))
                for side, hand, score in _sorted_hands(result):
                    size = np.array([pixels.shape[1], pixels.shape[0]])
                    points[side][t] = (hand * size)[list(ORDERS["openpose"])]
                    confidence[side][t] = score
                listen(f"keypoints, frame {t} of {frames}")
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{model_file}: expected MediaPipe to run this model, found {reason}") from None
    found = {side: Keypoints(points[side], confidence[side]) for side in points if confidence[side].any()}
    if not found:
        raise InputError(f"{model_file}: expected a hand in the pictures, found none in {frames} frames")
    return found


def _sorted_hands(result: Any) -> list[tuple[Side, np.ndarray, float]]:
    """Side, points [21, 2] in shares of the picture, and score of the hands in one frame.

    Two hands of one side cannot both be right: the surer one keeps the side, the other gets the one that
    is left over.
    """
    hands = []
    for landmarks, handedness in zip(result.hand_landmarks, result.handedness, strict=True):
        best = handedness[0]
        points = np.array([[mark.x, mark.y] for mark in landmarks])
        hands.append((_SIDE_OF[best.category_name], points, float(best.score)))
    hands.sort(key=lambda hand: -hand[2])
    taken: list[tuple[Side, np.ndarray, float]] = []
    for side, points, score in hands[:2]:
        if any(other == side for other, _, _ in taken):
            side = "left" if side == "right" else "right"
        taken.append((side, points, score))
    return taken

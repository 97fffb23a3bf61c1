"""Clicks and SAM 2: prompts, the library's own model with random weights, and what is said without."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_artefacts import FRAME_SET
from tiny_sam2 import IMAGE, save_tiny_model

from bigs.checks import InputError
from bigs.preprocess.hands.keypoints import Keypoints
from bigs.preprocess.masks.clicks import Click, add_hand_clicks, read_clicks
from bigs.preprocess.masks.sam2 import load_sam2, segment_clip
from bigs.types import MASK_VALUES

SIZE = (96, 64)
T = 5
FRAMES = replace(FRAME_SET, names=tuple(f"{t:04d}.png" for t in range(T)), width=SIZE[0], height=SIZE[1])


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("transformers")
    return save_tiny_model(tmp_path_factory.mktemp("sam2"))


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("frames")
    rng = np.random.default_rng(0)
    files = []
    for t in range(T):
        files.append(folder / f"{t:04d}.png")
        Image.fromarray(rng.integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)).save(files[-1])
    return files


def click(frame: int, x: float, y: float, box: list[float] | None = None) -> Click:
    return Click(frame, np.array([[x, y]]), np.array([True]), None if box is None else np.array(box))


@pytest.mark.slow
def test_the_model_is_asked_in_every_frame_both_ways(weights: Path, images: list[Path]) -> None:
    asked: list[str] = []
    clicks = {"object": [click(2, 40, 30, [20, 10, 60, 50])], "right": [click(0, 5, 5)]}
    masks = segment_clip(load_sam2(weights), images, SIZE, clicks, asked.append)  # type: ignore[arg-type]
    assert len(masks) == T and all(mask.shape == (SIZE[1], SIZE[0]) for mask in masks)
    assert set(np.unique(masks)) <= {0, MASK_VALUES["object"], MASK_VALUES["right"]}
    frames = {text.split("frame ")[1].split()[0] for text in asked if text.startswith("object")}
    assert frames == {"0", "1", "2", "3", "4"}


@pytest.mark.slow
def test_masks_depend_on_the_clicks_and_repeat(weights: Path, images: list[Path]) -> None:
    model = load_sam2(weights)
    first = segment_clip(model, images, SIZE, {"object": [click(0, 10, 10)]})
    again = segment_clip(model, images, SIZE, {"object": [click(0, 10, 10)]})
    other = segment_clip(model, images, SIZE, {"object": [click(0, 80, 50, [60, 30, 95, 60])]})
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert any((a != b).any() for a, b in zip(first, other, strict=True))


@pytest.mark.slow
def test_clicks_reach_the_model_in_its_own_pixels(
    weights: Path, images: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

    given: list[Any] = []
    add = Sam2VideoInferenceSession.add_point_inputs
    monkeypatch.setattr(
        Sam2VideoInferenceSession,
        "add_point_inputs",
        lambda self, place, frame, inputs: (given.append(inputs), add(self, place, frame, inputs))[1],
    )
    segment_clip(load_sam2(weights), images, SIZE, {"object": [click(1, 48, 32, [24, 16, 72, 48])]})
    points = given[0]["point_coords"][0, 0].numpy()
    assert np.allclose(points / IMAGE, [[0.25, 0.25], [0.75, 0.75], [0.5, 0.5]])
    assert given[0]["point_labels"][0, 0].tolist() == [2, 3, 1]


@pytest.mark.slow
def test_missing_or_other_weights_are_told_in_a_sentence(weights: Path, tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match="found no such folder; give one, or masks of another tool with --masks"
    ):
        load_sam2(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"expected config\.json and model\.safetensors, found nothing"):
        load_sam2(tmp_path / "empty")
    partial = Path(shutil.copytree(weights, tmp_path / "partial"))
    from safetensors.torch import load_file, save_file

    tensors = load_file(partial / "model.safetensors")
    tensors.pop(next(name for name in tensors if name.startswith("mask_decoder")))
    save_file(tensors, partial / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(InputError, match="expected all weights of a SAM 2 video model"):
        load_sam2(partial)
    (partial / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(InputError, match="partial"):
        load_sam2(partial)


def write(folder: Path, frames: dict[str, Any], **others: Any) -> Path:
    file = folder / "clicks.json"
    file.write_text(json.dumps({"frames": frames, **others}))
    return file


def test_clicks_by_name_and_by_number(tmp_path: Path) -> None:
    thinned = replace(FRAMES, source_frames=(0, 2, 4, 6, 8), source_length=9, source_size=(192, 128))
    prompt = {"points": [[20, 30, 1], [40, 50, 0]], "box": [10, 10, 60, 60]}
    found = read_clicks(write(tmp_path, {"0003.png": {"object": prompt}, "4": {"left": prompt}}), thinned)
    (first,), (second,) = found["object"], found["left"]
    assert (first.frame, second.frame) == (3, 2)
    assert first.points.tolist() == [[10, 15], [20, 25]] and first.on.tolist() == [True, False]
    assert first.box is not None and first.box.tolist() == [5, 5, 30, 30]


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        ({"9": {"object": {"points": [[1, 1, 1]]}}}, "its number in the source (0 to 4), found '9'"),
        ({"0": {"cup": {"points": [[1, 1, 1]]}}}, "expected one of right, left, object, found 'cup'"),
        ({"0": {"object": {"points": [[1, 1]]}}}, "object.points: expected shape [N, 3]"),
        ({"0": {"object": {"points": [[1, 1, 0]]}}}, "found only points beside it"),
        (
            {"0": {"object": {"points": [[500, 1, 1]]}}},
            "expected points within the picture, found [500.0, 1.0]",
        ),
        ({"0": {"object": {"box": [5, 5, 1, 9]}}}, "expected x0 y0 x1 y1"),
        ({"0": {"object": {"label": 1}}}, "expected points or box, found label"),
        ({}, "expected clicks on the object or a hand, found none"),
    ],
)
def test_bad_clicks_are_named(tmp_path: Path, frames: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError) as caught:
        read_clicks(write(tmp_path, frames), FRAMES)
    assert words in str(caught.value) and "clicks.json" in str(caught.value)


def test_keypoints_stand_in_for_clicks_on_hands() -> None:
    points = np.zeros((T, 21, 2))
    points[3] = np.random.default_rng(0).uniform(20, 60, (21, 2))
    confidence = np.zeros((T, 21))
    confidence[3], confidence[1] = 0.9, 0.2
    hand = Keypoints(points, confidence)
    mine = {"right": [click(0, 1, 1)], "object": [click(0, 2, 2)]}
    both = add_hand_clicks(mine, {"right": hand, "left": hand}, FRAMES)  # type: ignore[arg-type]
    assert both["right"] is mine["right"]
    (found,) = both["left"]
    assert found.frame == 3 and found.on.all() and found.box is not None
    assert (points[3] >= found.box[:2]).all() and (points[3] <= found.box[2:]).all()
    assert found.box.min() >= 0 and found.box[2] <= SIZE[0] and found.box[3] <= SIZE[1]

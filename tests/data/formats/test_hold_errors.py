"""Every way a `build` folder can be wrong is answered by one sentence that names the file and the field."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from small_clip import FRAMES, HEIGHT, WIDTH

from bigs.checks import InputError
from bigs.data.formats.hold import load_hold

Change = Callable[[dict[str, Any]], Any]


def message(folder: Path) -> str:
    with pytest.raises(InputError) as caught:
        load_hold(folder)
    text = str(caught.value)
    assert "\n" not in text and "expected" in text and "found" in text
    return text


def test_missing_folder(tmp_path: Path) -> None:
    assert "nowhere" in message(tmp_path / "nowhere")


@pytest.mark.parametrize("missing", ["data.npy", "image", "mask"])
def test_missing_part(write_small: Callable[..., Path], missing: str) -> None:
    folder = write_small()
    (folder / "build" / missing).rename(folder / "elsewhere")
    assert missing in message(folder)


@pytest.mark.parametrize(
    ("remove", "names"),
    [("mask/0002.png", "mask"), ("image/0004.png", "corres.txt"), ("mask/0004.png", "mask")],
)
def test_missing_frame(write_small: Callable[..., Path], remove: str, names: str) -> None:
    folder = write_small()
    (folder / "build" / remove).unlink()
    text = message(folder)
    assert names in text and str(FRAMES) in text and str(FRAMES - 1) in text


def test_names_that_are_not_text(write_small: Callable[..., Path]) -> None:
    folder = write_small()
    (folder / "build" / "corres.txt").write_bytes(b"\xff\xfe\x00")
    assert "corres.txt" in message(folder)


def test_mask_with_another_name(write_small: Callable[..., Path]) -> None:
    folder = write_small()
    (folder / "build" / "mask" / "0004.png").rename(folder / "build" / "mask" / "0005.png")
    assert "0005.png" in message(folder)


def replace_mask(folder: Path, pixels: np.ndarray) -> None:
    Image.fromarray(pixels).save(folder / "build" / "mask" / "0001.png")


def test_mask_of_another_size(write_small: Callable[..., Path]) -> None:
    folder = write_small()
    replace_mask(folder, np.zeros((HEIGHT, WIDTH + 2), dtype=np.uint8))
    text = message(folder)
    assert "0001.png" in text and f"{WIDTH} x {HEIGHT}" in text and f"{WIDTH + 2} x {HEIGHT}" in text


@pytest.mark.parametrize("value", [1, 49, 128, 255])
def test_mask_with_another_value(write_small: Callable[..., Path], value: int) -> None:
    folder = write_small()
    pixels = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    pixels[3, 4] = value
    replace_mask(folder, pixels)
    text = message(folder)
    assert "0001.png" in text and "0, 50, 150, 250" in text and str(value) in text


def test_mask_in_colour(write_small: Callable[..., Path]) -> None:
    folder = write_small()
    replace_mask(folder, np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8))
    assert "0001.png" in (text := message(folder)) and "RGB" in text


def test_image_of_another_size(write_small: Callable[..., Path]) -> None:
    folder = write_small()
    Image.new("RGB", (WIDTH - 1, HEIGHT)).save(folder / "build" / "image" / "0003.png")
    assert "image/0003.png" in message(folder)


@pytest.mark.parametrize("file", ["image/0000.png", "image/0003.png", "mask/0003.png"])
@pytest.mark.parametrize("keep", [0, 0.1, 0.6])
def test_truncated_frame(write_small: Callable[..., Path], file: str, keep: float) -> None:
    path = (folder := write_small()) / "build" / file
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    assert file in message(folder)


def test_truncated_jpeg(write_small: Callable[..., Path]) -> None:
    folder = write_small()
    path = folder / "build" / "image" / "0002.jpg"
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)
    path.with_suffix(".png").unlink()
    load_hold(folder)
    path.write_bytes(path.read_bytes()[:-200])
    assert "0002.jpg" in message(folder)


def entity(name: str, key: str, value: Any) -> Change:
    return lambda data: data["entities"][name].__setitem__(key, value)


def pose(name: str, key: str, frame: int, value: float) -> Change:
    return lambda data: data["entities"][name][key].__setitem__((frame, 1), value)


def camera(rows: Any, value: Any, frame: int = 3) -> Change:
    return lambda data: data["cameras"][f"world_mat_{frame}"].__setitem__(rows, value)


def all_cameras(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def edit(data: dict[str, Any]) -> None:
        for t in range(FRAMES):
            matrix = data["cameras"][f"world_mat_{t}"]
            data["cameras"][f"world_mat_{t}"] = change(matrix)

    return edit


SKEW = np.diag([1.0, 1.0, 1.0, 1.0]) + 0.5 * np.eye(4, k=1) * np.array([1, 0, 0, 0])[:, None]
NO_FOCAL = np.array([[0.0, 0, 12], [0, 0, 8], [0, 0, 1]])
TURNED_CAMERA = np.diag([1.0, -1.0, -1.0])

CASES: dict[str, tuple[Change, tuple[str, ...]]] = {
    "NaN pose": (pose("left", "hand_poses", 3, np.nan), ("entities.left.hand_poses", "nan", "frame 3")),
    "infinite position": (pose("right", "hand_trans", 1, np.inf), ("right.hand_trans", "inf", "frame 1")),
    "NaN object": (pose("object", "object_poses", 2, np.nan), ("object.object_poses", "nan", "frame 2")),
    "NaN shape": (entity("left", "mean_shape", np.full(10, np.nan)), ("left.mean_shape", "nan")),
    "45 pose numbers": (entity("left", "hand_poses", np.zeros((FRAMES, 45))), ("hand_poses", "48", "45")),
    "too few poses": (entity("left", "hand_poses", np.zeros((4, 48))), ("hand_poses", "[5, 48]", "[4, 48]")),
    "too many poses": (entity("object", "object_poses", np.zeros((6, 6))), ("object_poses", "5", "6")),
    "flat translation": (entity("right", "hand_trans", np.zeros(15)), ("right.hand_trans", "[15]")),
    "text for poses": (entity("right", "hand_trans", "here"), ("right.hand_trans", "str")),
    "12 betas": (entity("right", "mean_shape", np.zeros(12)), ("mean_shape", "10", "12")),
    "no poses": (lambda d: d["entities"]["right"].pop("hand_poses"), ("entities.right.hand_poses", "only")),
    "hand is a list": (lambda d: d["entities"].__setitem__("right", [1]), ("entities.right", "list")),
    "points in 2D": (entity("object", "pts.cano", np.zeros((9, 2))), ("pts.cano", "[9, 2]")),
    "no points": (entity("object", "pts.cano", np.zeros((0, 3))), ("pts.cano", "at least one")),
    "colours of others": (entity("object", "pts.rgb", np.zeros((9, 3), np.uint8)), ("pts.rgb", "30", "9")),
    "colours to 255": (entity("object", "pts.rgb", np.full((30, 3), 200.0)), ("pts.rgb", "200")),
    "no frames a second": (lambda d: d.__setitem__("fps", 0), ("data.npy: fps", "positive", "0")),
    "infinitely many": (lambda d: d.__setitem__("fps", float("inf")), ("data.npy: fps", "inf")),
    "rate as text": (lambda d: d.__setitem__("fps", "30"), ("data.npy: fps", "number")),
    "zero scale": (entity("object", "obj_scale", 0.0), ("obj_scale", "positive")),
    "NaN scale": (entity("object", "obj_scale", float("nan")), ("obj_scale", "nan")),
    "scale that is a truth value": (entity("object", "obj_scale", True), ("obj_scale", "number", "True")),
    "scale of 500 digits": (entity("object", "obj_scale", 10**500), ("obj_scale", "501 digits")),
    "scale of 5000 digits": (entity("object", "obj_scale", 10**5000), ("obj_scale", "5001 digits")),
    "scale that is an array of one": (
        entity("object", "obj_scale", np.array([True])),
        ("obj_scale", "number"),
    ),
    "mirrored norm_mat": (entity("object", "norm_mat", np.diag([-1.0, 1, 1, 1])), ("norm_mat", "mirrors")),
    "object turned by 1e12": (pose("object", "object_poses", 2, 1e12), ("object_poses", "turns", "frame 2")),
    "hand turned by 1e12": (pose("left", "hand_poses", 2, 1e12), ("hand_poses", "turns", "frame 2")),
    "two scales": (entity("object", "obj_scale", np.ones(2)), ("obj_scale", "one number")),
    "ragged poses": (entity("left", "hand_poses", [[0.0], [1.0, 2.0]]), ("left.hand_poses", "numbers")),
    "poses of 1e20": (entity("left", "hand_poses", np.full((FRAMES, 48), 1e20)), ("hand_poses", "1e+20")),
    "singular norm_mat": (entity("object", "norm_mat", np.zeros((4, 4))), ("norm_mat", "invertible")),
    "all invalid": (entity("left", "is_valid", np.zeros(FRAMES)), ("left.is_valid", "at least one")),
    "odd validity": (entity("left", "is_valid", np.full(FRAMES, 2)), ("left.is_valid", "2")),
    "a name that is an array": (lambda d: d.__setitem__("seq_name", np.ones(3)), ("seq_name", "not text")),
    "a name that is a list": (lambda d: d.__setitem__("seq_name", []), ("seq_name", "not text")),
    "no entity": (lambda d: d["entities"].clear(), ("entities", "right, left, object", "none")),
    "no entities": (lambda d: d.pop("entities"), ("entities",)),
    "no cameras": (lambda d: d.pop("cameras"), ("cameras",)),
    "no shift": (lambda d: d.pop("normalize_shift"), ("normalize_shift",)),
    "camera missing": (lambda d: d["cameras"].pop("world_mat_3"), ("cameras", "5", "4")),
    "no scale_mat": (lambda d: d["cameras"].pop("scale_mat_0"), ("scale_mat_0",)),
    "NaN camera": (camera((0, 0), np.nan), ("world_mat_3", "nan")),
    "other focal": (camera((0, 0), 70.0), ("world_mat_3", "world_mat_0")),
    "3x4 camera": (
        lambda d: d["cameras"].__setitem__("world_mat_0", np.eye(4)[:3]),
        ("world_mat_0", "[3, 4]"),
    ),
    "zero camera": (camera(slice(0, 3), 0.0, frame=0), ("world_mat_0", "direction")),
    "skewed camera": (all_cameras(lambda m: m @ SKEW), ("world_mat_0", "skew")),
    "mirrored camera": (all_cameras(lambda m: m @ np.diag([-1.0, 1, 1, 1])), ("world_mat_0", "mirrored")),
    "no focal length": (
        all_cameras(lambda m: np.block([[NO_FOCAL @ TURNED_CAMERA, m[:3, 3:]], [m[3:]]])),
        ("world_mat_0", "focal"),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_data(edit_data: Callable[[Change], Path], case: str) -> None:
    change, words = CASES[case]
    text = message(edit_data(change))
    assert "data.npy" in text
    for word in words:
        assert word in text


def test_the_unedited_clip_loads(edit_data: Callable[[Change], Path]) -> None:
    load_hold(edit_data(lambda data: None))


def test_no_entity_that_we_know(edit_data: Callable[[Change], Path]) -> None:
    text = message(edit_data(lambda data: data.__setitem__("entities", {"person": {}})))
    assert "person" in text


class Harmful:
    """Its pickle asks the reader to make a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.mkdir, (str(self.folder),)


def test_a_pickle_that_runs_code(edit_data: Callable[[Change], Path], tmp_path: Path) -> None:
    text = message(edit_data(lambda data: data.__setitem__("extra", Harmful(tmp_path / "harm"))))
    assert "data.npy" in text and "mkdir" in text
    assert not (tmp_path / "harm").exists()


def test_data_that_is_not_a_pickle(write_small: Callable[..., Path]) -> None:
    folder = write_small()
    (folder / "build" / "data.npy").write_text("hello")
    assert "data.npy" in message(folder)


def test_data_that_is_an_array(write_small: Callable[..., Path]) -> None:
    folder = write_small()
    np.save(folder / "build" / "data.npy", np.zeros(3))
    assert "dictionary" in message(folder)

"""`scene.safetensors` is checked whole: a changed bit is told, and what does not fit is named."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from small_scene import make_scene

from bigs.checks import InputError
from bigs.checksum import checksum
from bigs.models.playback import record
from bigs.models.playback_file import load_playback, save_playback


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "scene.safetensors"
    names = tuple(f"{t:04d}.png" for t in range(4))
    save_playback(path, record(make_scene(), "clip", names, (0.0, 0.0, -1.0)))
    return path


@pytest.fixture
def forge(whole: Path, tmp_path: Path) -> Callable[..., Path]:
    """Writes the scene with other facts and tensors, and a checksum that fits them."""

    def write(
        facts: dict[str, Any] | None = None, tensors: dict[str, torch.Tensor | None] | None = None
    ) -> Path:
        with safe_open(whole, framework="pt") as file:
            stored = json.loads(file.metadata()["bigs"])
            kept = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        stored = {key: value for key, value in stored.items() if key != "checksum"} | (facts or {})
        kept = {name: value for name, value in (kept | (tensors or {})).items() if value is not None}
        stored["checksum"] = checksum(json.dumps(stored), kept)
        save_file(kept, tmp_path / "scene.safetensors", {"bigs": json.dumps(stored)})
        return tmp_path / "scene.safetensors"

    return write


def test_a_forged_scene_that_fits_is_read(forge: Callable[..., Path]) -> None:
    assert load_playback(forge({"name": "other"})).name == "other"


def test_the_black_of_pale_pictures(whole: Path, forge: Callable[..., Path], tmp_path: Path) -> None:
    save_playback(tmp_path / "pale.safetensors", replace(load_playback(whole), black=0.25))
    assert load_playback(tmp_path / "pale.safetensors").black == 0.25
    for black in (-0.1, 1.0, float("nan"), "0.2", False, None):
        with pytest.raises(InputError, match="black: expected a number from 0 to 1"):
            load_playback(forge({"black": black}))


def test_frames_a_second(whole: Path, forge: Callable[..., Path], tmp_path: Path) -> None:
    slow = replace(load_playback(whole), fps=12.5)
    save_playback(tmp_path / "slow.safetensors", slow)
    assert load_playback(tmp_path / "slow.safetensors").fps == 12.5
    for fps in (0.0, -1.0, float("nan"), "30", True, None):
        with pytest.raises(InputError, match="fps: expected a positive number"):
            load_playback(forge({"fps": fps}))


def test_a_scene_of_before_there_were_frames_a_second_and_black(whole: Path, tmp_path: Path) -> None:
    with safe_open(whole, framework="pt") as file:
        facts = json.loads(file.metadata()["bigs"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    del facts["fps"], facts["black"], facts["checksum"]
    facts["checksum"] = checksum(json.dumps(facts), tensors)
    save_file(tensors, tmp_path / "scene.safetensors", {"bigs": json.dumps(facts)})
    found = load_playback(tmp_path / "scene.safetensors")
    assert (found.fps, found.black) == (30.0, 0.0)


def test_any_changed_byte_is_told(whole: Path, tmp_path: Path) -> None:
    content = whole.read_bytes()
    path = tmp_path / "scene.safetensors"
    for place in np.random.default_rng(0).integers(0, len(content), 12):
        changed = bytearray(content)
        changed[place] ^= 1
        path.write_bytes(changed)
        with pytest.raises(InputError, match=r"scene\.safetensors"):
            load_playback(path)


def test_a_scene_of_before_there_was_a_checksum(whole: Path, tmp_path: Path) -> None:
    with safe_open(whole, framework="pt") as file:
        facts = json.loads(file.metadata()["bigs"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    del facts["checksum"]
    path = tmp_path / "scene.safetensors"
    save_file(tensors, path, {"bigs": json.dumps(facts | {"format": "bigs-scene-3"})})
    assert len(load_playback(path)) == 4
    save_file(tensors, path, {"bigs": json.dumps(facts | {"format": "bigs-scene-5"})})
    with pytest.raises(InputError, match=r"checksum .* found None: .* --resume"):
        load_playback(path)


def test_a_scene_of_before_there_was_occlusion(whole: Path, forge: Callable[..., Path]) -> None:
    """It looks as it did: nothing covers anything."""
    playback = load_playback(whole)
    subjects = (*playback.hands, "object")
    assert playback.object.occlusion.any()
    gone = {f"{name}.{field}": None for name in subjects for field in ("occlusion", "ambient")}
    found = load_playback(forge({"format": "bigs-scene-4"}, gone))
    assert not found.object.occlusion.any() and not found.hands["left"].ambient.any()
    assert found.object.occlusion.shape == playback.object.occlusion.shape
    bare = replace(playback.object, ambient=torch.zeros(3))
    expected = replace(playback, object=bare).gaussians([1], ["object"]).colors
    torch.testing.assert_close(found.gaussians([1], ["object"]).colors, expected)


def test_an_earlier_scene_of_too_many_frames_and_gaussians(forge: Callable[..., Path]) -> None:
    """What stands for its occlusion has a byte for each of a product that the file does not hold."""
    many = {
        "object.shade": torch.zeros(100_000, 20),
        "object.splats.means": torch.zeros(100_000, 3),
        "object.occlusion": None,
    }
    with pytest.raises(InputError, match=r"object: expected at most .* found 100000 frames of 100000"):
        load_playback(forge({"format": "bigs-scene-4"}, many))


@pytest.mark.parametrize(
    "text", ["{", "[]", "null", "7", "[" * 100_000, '{"format": ' + "9" * 5000 + "}", '{"format": [1]}']
)
def test_metadata_that_is_none(whole: Path, tmp_path: Path, text: str) -> None:
    path = tmp_path / "scene.safetensors"
    save_file({"x": torch.zeros(1)}, path, {"bigs": text})
    with pytest.raises(InputError, match=r"scene\.safetensors: .*expected .* found") as raised:
        load_playback(path)
    assert len(str(raised.value)) < 600


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"name": None}, "name: expected"),
        ({"frame_names": []}, "frame_names"),
        ({"frame_names": ["a", 1, "c", "d"]}, "frame_names"),
        ({"frame_names": ["a"]}, r"expected shape \[1"),
        ({"frame_names": {"a": 1}}, "frame_names"),
        ({"size": [0, 5]}, "size"),
        ({"size": [True, 5]}, "size"),
        ({"size": [10**400, 5]}, "expected .* found"),
        ({"size": 5}, "size"),
        ({"normalize_shift": [0.0, 0.0]}, "normalize_shift"),
        ({"normalize_shift": [0.0, 0.0, float("nan")]}, "normalize_shift"),
        ({"normalize_shift": None}, "normalize_shift"),
    ],
)
def test_facts_that_do_not_fit(forge: Callable[..., Path], facts: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_playback(forge(facts))


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("right.faces", lambda v: v + 100_000, "indices from 0"),
        ("object.faces", lambda v: v - 1, "found -1"),
        ("object.faces", lambda v: v.float(), "expected int64"),
        ("right.tip_vertex_ids", lambda v: v - 10_000, "indices below"),
        ("object.rotations", lambda v: -v, "determinant"),
        ("object.rotations", lambda v: 0.0 * v, "rotation"),
        ("object.scale", lambda v: -v, "positive"),
        ("object.verts", lambda v: v / 0.0, "finite|nan|inf"),
        ("right.joints", lambda v: v[:, :20].clone(), "shape"),
        ("right.verts", lambda v: v[0].clone(), "shape"),
        ("right.bones", lambda v: None, "expected a tensor right.bones"),
        ("right.splats.scales", lambda v: v[:-1].clone(), "shape"),
        ("right.v_posed", lambda v: torch.zeros(3), "shape"),
        ("K", lambda v: v.double(), "float32"),
        ("other", lambda v: torch.zeros(2), "expected no tensor other"),
        ("object.scale", lambda v: torch.ones(1), "shape"),
    ],
)
def test_tensors_that_do_not_fit(
    whole: Path, forge: Callable[..., Path], name: str, change: Any, words: str
) -> None:
    with safe_open(whole, framework="pt") as file:
        value = file.get_tensor(name) if name in file.keys() else None  # noqa: SIM118
    with pytest.raises(InputError, match=words):
        load_playback(forge(tensors={name: change(value)}))

"""Artefacts come back as they were written, and say when they are out of date."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bigs.checks import InputError
from bigs.data.base import HandTrack
from bigs.preprocess.artefacts import (
    USUAL_DEPTH_SIGMA,
    Alignment,
    FrameSet,
    ObjectSfm,
    read_alignment,
    read_depth_sigma,
    read_frame_set,
    read_hands,
    read_object_sfm,
    write_alignment,
    write_frame_set,
    write_hands,
    write_object_sfm,
)
from bigs.preprocess.stamps import content_digest, state_of, write_npz

T = 4
FRAME_SET = FrameSet(
    names=("a.jpg", "b.jpg"),
    fps=15.0,
    width=64,
    height=48,
    K=np.array([[70.0, 0, 31.5], [0, 71.0, 24.25], [0, 0, 1]]),
    camera="--focal",
    focal_known=True,
)


def hand(seed: int = 0) -> HandTrack:
    rng = np.random.default_rng(seed)
    return HandTrack(
        rng.normal(size=(T, 3)),
        rng.normal(size=(T, 15, 3)),
        rng.normal(size=(T, 3)),
        rng.normal(size=10),
        np.array([1, 0, 1, 1], bool),
    )


def sfm() -> ObjectSfm:
    rng = np.random.default_rng(1)
    return ObjectSfm(
        Rotation.random(T, random_state=rng).as_matrix(),
        rng.normal(size=(T, 3)),
        np.array([1, 1, 0, 1], bool),
        rng.random(T),
        rng.normal(size=(30, 3)),
        rng.integers(0, 256, (30, 3), dtype=np.uint8),
        np.diag([2.0, 2, 2, 1]),
    )


def same(first: object, second: object) -> bool:
    return all(
        np.array_equal(getattr(first, k), v) for k, v in vars(second).items() if not isinstance(v, dict)
    )


def test_every_artefact_comes_back(tmp_path: Path) -> None:
    write_frame_set(tmp_path, FRAME_SET, "x")
    assert same(read_frame_set(tmp_path), FRAME_SET)
    write_hands(tmp_path / "hands.npz", {"right": hand(0), "left": hand(1)}, "x")
    hands = read_hands(tmp_path / "hands.npz", T)
    assert same(hands["right"], hand(0)) and same(hands["left"], hand(1))
    write_object_sfm(tmp_path / "sfm.npz", sfm(), "x")
    assert same(read_object_sfm(tmp_path / "sfm.npz", T), sfm())
    aligned = Alignment(
        0.3, sfm().rotations, sfm().transl, sfm().valid, {"left": np.arange(3.0 * T).reshape(T, 3)}
    )
    write_alignment(tmp_path / "aligned.npz", aligned, "x")
    found = read_alignment(tmp_path / "aligned.npz", T)
    assert same(found, aligned) and found.hand_transl.keys() == {"left"}
    assert np.array_equal(found.hand_transl["left"], aligned.hand_transl["left"])


def test_how_far_depth_is_off_comes_back(tmp_path: Path) -> None:
    file = tmp_path / "hands.npz"
    write_hands(file, {"right": hand(0)}, "x", 0.01)
    assert read_depth_sigma(file) == 0.01
    stored = dict(np.load(file))
    del stored["depth_sigma"]
    np.savez(file, **stored)
    assert read_depth_sigma(file) == USUAL_DEPTH_SIGMA
    np.savez(file, **stored, depth_sigma=-1.0)
    with pytest.raises(InputError, match="depth_sigma: expected a positive number, found -1"):
        read_depth_sigma(file)


def test_an_artefact_is_current_until_an_input_changes(tmp_path: Path) -> None:
    source, folder = tmp_path / "in.txt", tmp_path / "images"
    folder.mkdir()
    (folder / "0.png").write_bytes(b"pixels")
    source.write_text("one")

    def inputs(setting: float = 1.0) -> str:
        return content_digest(source, folder, {"setting": setting, "K": FRAME_SET.K})

    made = tmp_path / "made.npz"
    assert state_of(made, inputs()) == "missing"
    write_npz(made, {"a": np.zeros(2)}, inputs())
    assert state_of(made, inputs()) == "current"
    assert state_of(made, inputs(2.0)) == "outdated"
    (folder / "0.png").write_bytes(b"others")
    assert state_of(made, inputs()) == "outdated"
    (folder / "0.png").write_bytes(b"pixels")
    assert state_of(made, inputs()) == "current"
    (folder / "0.png").rename(folder / "1.png")
    assert state_of(made, inputs()) == "outdated"
    source.unlink()
    assert state_of(made, inputs()) == "outdated"


def test_what_another_tool_wrote_is_kept(tmp_path: Path) -> None:
    np.savez(tmp_path / "hands.npz", a=np.zeros(1))
    (tmp_path / "frames.json").write_text('{"names": ["a"]}')
    assert state_of(tmp_path / "hands.npz", "digest") == "supplied"
    assert state_of(tmp_path / "frames.json", "digest") == "supplied"


def test_an_older_version_is_made_anew(tmp_path: Path) -> None:
    np.savez(tmp_path / "hands.npz", version=0, inputs="digest")
    assert state_of(tmp_path / "hands.npz", "digest") == "outdated"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"R": np.zeros((T, 3, 3))}, "rotation matrices"),
        ({"t": np.zeros((T + 1, 3))}, "expected shape [4, 3], found [5, 3]"),
        ({"points": np.full((30, 3), np.nan)}, "finite"),
        ({"norm_mat": None}, "norm_mat: expected this field"),
    ],
)
def test_a_wrong_field_is_named(tmp_path: Path, change: dict[str, np.ndarray | None], words: str) -> None:
    file = tmp_path / "object_sfm.npz"
    write_object_sfm(file, sfm(), "x")
    with np.load(file) as stored:
        arrays = dict(stored) | change
    np.savez(file, **{key: value for key, value in arrays.items() if value is not None})
    with pytest.raises(InputError) as caught:
        read_object_sfm(file, T)
    assert str(file) in str(caught.value) and words in str(caught.value)


def test_damaged_files_are_refused_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "frames.json").write_text("{")
    (tmp_path / "hands.npz").write_bytes(b"PK\x03\x04 cut")
    for read in (
        lambda: read_frame_set(tmp_path),
        lambda: read_hands(tmp_path / "hands.npz", T),
        lambda: state_of(tmp_path / "hands.npz", "x"),
        lambda: read_hands(tmp_path / "none.npz", T),
    ):
        with pytest.raises(InputError, match="expected"):
            read()
    write_frame_set(tmp_path, replace(FRAME_SET, K=np.zeros((3, 3))), "x")
    with pytest.raises(InputError, match="K: expected positive focal lengths"):
        read_frame_set(tmp_path)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("source_size", 3),
        ("source_size", [1, None]),
        ("source_frames", None),
        ("source_frames", [0.5]),
        ("source_length", "many"),
        ("source_length", -1),
        ("width", [1]),
        ("width", 0.5),
        ("height", 0),
        ("height", 1e6),
        ("fps", float("nan")),
    ],
)
def test_every_field_of_the_frames_is_checked(tmp_path: Path, field: str, value: object) -> None:
    write_frame_set(tmp_path, FRAME_SET, "digest")
    file = tmp_path / "frames.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {field: value}))
    with pytest.raises(InputError, match=f"frames.json: {field}: expected"):
        read_frame_set(tmp_path)


def test_the_sources_frames_are_those_of_the_names(tmp_path: Path) -> None:
    for places, length in (((0,), 9), ((), 9), ((3, 9), 9), ((0, 1, 2), 0)):
        write_frame_set(tmp_path, replace(FRAME_SET, source_frames=places, source_length=length), "")
        with pytest.raises(InputError, match=r"frames.json: source_frames: expected"):
            read_frame_set(tmp_path)
    for places, length in (((), 0), ((), 2), ((3, 8), 9), ((3, 8), 0)):
        write_frame_set(tmp_path, replace(FRAME_SET, source_frames=places, source_length=length), "")
        assert read_frame_set(tmp_path).source_frames == places


@pytest.mark.parametrize("version", [None, [1], "one", 10**90])
def test_a_version_that_is_none_is_out_of_date(tmp_path: Path, version: object) -> None:
    file = tmp_path / "masks.json"
    file.write_text(json.dumps({"version": version, "inputs": "digest"}))
    assert state_of(file, "digest") == "outdated"


def test_a_name_that_is_no_text_has_a_digest(tmp_path: Path) -> None:
    (tmp_path / os.fsdecode(b"\xff.png")).write_bytes(b"")
    assert content_digest(tmp_path) != content_digest(tmp_path / "nothing")

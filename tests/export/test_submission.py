"""The challenge's zip: packed, opened by other means, and refused for every single thing that is wrong."""

from __future__ import annotations

import io
import sys
import types
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bigs.checks import InputError
from bigs.export.challenge import load_challenge, write_challenge
from bigs.export.submission import TEST_SEQUENCES, check_submission, write_submission
from bigs.types import HandObjectTrajectory

NAMES = ("arctic_s05_box_grab_01_1", "arctic_s05_mixer_grab_01_1")


def trajectory(name: str, seed: int) -> HandObjectTrajectory:
    rng = np.random.default_rng(seed)
    return HandObjectTrajectory(
        name=name,
        frame_names=("00100.jpg", "00101.jpg"),
        joints={side: 0.1 * rng.normal(size=(2, 21, 3)) + [0, 0, 0.7] for side in ("right", "left")},
        verts={side: 0.1 * rng.normal(size=(2, 30, 3)) + [0, 0, 0.7] for side in ("right", "left")},
        faces={side: rng.integers(0, 30, size=(50, 3)) for side in ("right", "left")},
        object_verts=0.1 * rng.normal(size=(2, 40, 3)) + [0, 0, 0.7],
        object_faces=rng.integers(0, 40, size=(60, 3)),
    )


@pytest.fixture
def predictions(tmp_path: Path) -> list[Path]:
    files = [tmp_path / f"{name}.pt" for name in NAMES]
    for seed, file in enumerate(files):
        write_challenge(file, trajectory(file.stem, seed), (0, 0, -1), v_posed_left=np.full((30, 3), 0.1))
    return files


@pytest.fixture
def archive(tmp_path: Path, predictions: list[Path]) -> Path:
    write_submission(tmp_path / "arctic_preds.zip", predictions, NAMES)
    return tmp_path / "arctic_preds.zip"


def test_the_zip_holds_each_sequence_as_it_was(archive: Path, predictions: list[Path]) -> None:
    found = check_submission(archive, NAMES)
    assert [(clip.sequence, clip.frames, clip.object_verts) for clip in found] == [(n, 2, 40) for n in NAMES]
    with zipfile.ZipFile(archive) as stored:
        assert stored.testzip() is None
        assert stored.namelist() == [f"arctic_preds/{name}.pt" for name in NAMES]
        for name, file in zip(stored.namelist(), predictions, strict=True):
            content = torch.load(io.BytesIO(stored.read(name)), weights_only=True)
            assert type(content) is dict and content["full_seq_name"] == file.stem


def test_holds_class_is_what_its_evaluator_finds(
    tmp_path: Path, predictions: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = tmp_path / "hold.zip"
    assert write_submission(archive, predictions, NAMES, hold_class=True) == check_submission(archive, NAMES)
    package, module = types.ModuleType("common"), types.ModuleType("common.xdict")

    class xdict(dict[str, Any]):
        def to_std_precision(self) -> dict[str, Any]:
            return {k: v.float() if isinstance(v, torch.Tensor) else v for k, v in self.items()}

    monkeypatch.setattr(module, "xdict", xdict, raising=False)
    monkeypatch.setitem(sys.modules, "common", package)
    monkeypatch.setitem(sys.modules, "common.xdict", module)
    with zipfile.ZipFile(archive) as stored:
        content = stored.read(f"arctic_preds/{NAMES[1]}.pt")
    # As the evaluator opens it; the bytes are those that this test has just written.
    opened = torch.load(io.BytesIO(content), weights_only=False)
    assert type(opened) is xdict
    expected = torch.load(predictions[1], weights_only=True)
    for key, values in opened.to_std_precision().items():
        if isinstance(values, torch.Tensor):
            assert torch.equal(values, expected[key].float()), key
    file = tmp_path / "one.pt"
    file.write_bytes(content)
    assert load_challenge(file).name == NAMES[1]


def test_the_challenge_has_nine_sequences(archive: Path) -> None:
    assert len(set(TEST_SEQUENCES)) == 9 and TEST_SEQUENCES[0] == "arctic_s03_box_grab_01_1"
    with pytest.raises(InputError, match=r"expected the 9 sequences .* found no arctic_s03_box_grab_01_1"):
        check_submission(archive)
    with pytest.raises(InputError, match=f"each once, found '{NAMES[1]}'"):
        check_submission(archive, NAMES[:1])


def rewrite(archive: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change the dictionary of the second sequence."""
    with zipfile.ZipFile(archive) as stored:
        contents = {name: stored.read(name) for name in stored.namelist()}
    name = f"arctic_preds/{NAMES[1]}.pt"
    content = torch.load(io.BytesIO(contents[name]), weights_only=True)
    change(content)
    buffer = io.BytesIO()
    torch.save(content, buffer)
    with zipfile.ZipFile(archive, "w") as stored:
        for key, value in (contents | {name: buffer.getvalue()}).items():
            stored.writestr(key, value)


def without_left(content: dict[str, Any]) -> None:
    for key in [key for key in content if "left" in key]:
        del content[key]
    del content["faces"]["left"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.pop("j3d_ra.left"), "expected a field j3d_ra.left, found none"),
        (lambda c: c.pop("v3d_right.object"), "expected a field v3d_right.object"),
        (lambda c: c["faces"].pop("object"), "expected a field faces.object"),
        (without_left, "expected both hands and the object, found no root.left"),
        (
            lambda c: c.update({"root.right": c["root.right"].float()}),
            "root.right: expected float16, found float32",
        ),
        (
            lambda c: c["faces"].update(object=c["faces"]["object"].int()),
            "faces.object: expected int16, found int32",
        ),
        (
            lambda c: c.update({"j3d_c.left": c["j3d_c.left"][:, :20]}),
            r"j3d_c.left: expected shape \[2, 21, 3\]",
        ),
        (lambda c: c.update(full_seq_name=NAMES[0]), f"full_seq_name: expected {NAMES[1]}, found {NAMES[0]}"),
        (
            lambda c: c.update(fnames=["0000.png", "0001.png"]),
            r"fnames: expected \./data/.*/0000\.png as frame 0",
        ),
        (lambda c: c["j3d_c.right"].fill_(torch.nan), "j3d_c.right: expected finite values"),
        (lambda c: c["v3d_ra.object"].add_(0.5), "v3d_ra.object: expected v3d_c.object minus root.object"),
    ],
)
def test_what_is_wrong_is_named(archive: Path, change: Callable[[dict[str, Any]], None], words: str) -> None:
    rewrite(archive, change)
    with pytest.raises(InputError, match=f"arctic_preds/{NAMES[1]}.pt: {words}"):
        check_submission(archive, NAMES)


@pytest.mark.parametrize("name", ["../escape.pt", "arctic_preds/notes.txt", "arctic_s05_box_grab_01_1.pt"])
def test_other_files_are_refused(archive: Path, name: str) -> None:
    with zipfile.ZipFile(archive, "a") as stored:
        stored.writestr(name, b"x")
    with pytest.raises(InputError, match=r"expected only arctic_preds/SEQUENCE.pt, found "):
        check_submission(archive, NAMES)


def test_damaged_zips_are_named(tmp_path: Path, archive: Path, predictions: list[Path]) -> None:
    with pytest.raises(InputError, match="found no such file"):
        check_submission(tmp_path / "absent.zip", NAMES)
    damaged = bytearray(archive.read_bytes())
    damaged[200] ^= 0xFF
    archive.write_bytes(damaged)
    with pytest.raises(InputError, match="expected a whole member, found a damaged one"):
        check_submission(archive, NAMES)
    archive.write_bytes(b"PK")
    with pytest.raises(InputError, match="expected a zip file"):
        check_submission(archive, NAMES)
    predictions[0].write_bytes(b"junk")
    with pytest.raises(InputError, match="found data that cannot be read safely"):
        write_submission(tmp_path / "new.zip", predictions, NAMES)
    assert not (tmp_path / "new.zip").exists()

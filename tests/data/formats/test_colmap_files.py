"""COLMAP's binary files: whole ones pass, and those that announce what they have not are refused at once."""

from __future__ import annotations

import os
import struct
import time
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from bigs.checks import InputError
from bigs.data.formats.colmap_files import check_model_files


def count(number: int) -> bytes:
    return struct.pack("<Q", number)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """What COLMAP itself writes of two images with a few points."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=2, num_points3D=5
    )
    pycolmap.synthesize_dataset(options).write_binary(str(tmp_path))
    return tmp_path


def test_what_colmap_writes_passes(model: Path) -> None:
    check_model_files(model)
    assert {"rigs.bin", "frames.bin"} <= set(os.listdir(model))


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_cut_and_forged_files(model: Path, name: str) -> None:
    file = model / f"{name}.bin"
    content = file.read_bytes()
    began = time.process_time()
    rng = np.random.default_rng(0)
    forged = [content[:-1], content + b"\0", count(2**64 - 1) + content[8:], b"", content[:8]]
    for change in forged:
        file.write_bytes(change)
        with pytest.raises(InputError, match=rf"{name}\.bin: "):
            check_model_files(model)
    for at in rng.integers(8, len(content), 20):
        # Any four bytes may be a count; what passes has the length that it announces.
        file.write_bytes(content[:at] + b"\xff\xff\xff\xff" + content[at + 4 :])
        try:
            check_model_files(model)
        except InputError as error:
            assert len(str(error).splitlines()) == 1
    assert time.process_time() - began < 5


@pytest.mark.parametrize("name", ["cameras.bin", "points3D.txt", "rigs.bin", "frames.txt"])
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_what_is_no_file(model: Path, name: str, kind: str) -> None:
    (model / name).unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(model / name)
    else:
        (model / name).symlink_to("/dev/zero")
    with pytest.raises(InputError, match=rf"{name}: expected a file of a COLMAP model, found a {kind}"):
        check_model_files(model)

"""A flipped bit anywhere in an .npz is told in one sentence, or does no harm."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bigs.archives import read_npz
from bigs.checks import InputError
from bigs.export.poses import load_poses


def as_fields(path: Path) -> object:
    return read_npz(path, "an archive")


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed], ids=["stored", "compressed"])
@pytest.mark.parametrize("read", [as_fields, load_poses], ids=["fields", "poses"])
def test_every_damage_has_a_sentence(
    tmp_path: Path, read: Callable[[Path], object], save: Callable[..., None]
) -> None:
    buffer = io.BytesIO()
    save(buffer, K=np.eye(3), frame_names=np.array(["a", "b"]), x=np.arange(6.0))
    whole, file = buffer.getvalue(), tmp_path / "arrays.npz"
    named = 0
    for place in range(0, len(whole), 2):
        for bits in (0xFF, 0x08, 0x01):
            damaged = bytearray(whole)
            damaged[place] ^= bits
            file.write_bytes(damaged)
            try:
                with warnings.catch_warnings(action="ignore"):
                    read(file)
            except InputError as error:
                assert str(error).startswith(f"{file}: ")
                assert "expected " in str(error)
                named += 1
    assert named > 300

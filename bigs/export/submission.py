"""`arctic_preds.zip`, the submission to the ARCTIC bimanual category-agnostic challenge: a file per sequence.

The server reports no mistakes and answers after hours, so everything that it reads is checked here.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO, NamedTuple

import torch

from bigs.archives import open_zip, read_member
from bigs.atomic import atomic_write
from bigs.checks import InputError, shown
from bigs.export.challenge import validate_challenge
from bigs.files import MIB, open_regular, read_bytes
from bigs.torch_files import load_torch
from bigs.types import ENTITIES

# The challenge's clips, and the paper's: the nine grasps of the hidden subject 3, seen by camera 1.
TEST_OBJECTS = (
    "box",
    "capsulemachine",
    "espressomachine",
    "ketchup",
    "laptop",
    "microwave",
    "mixer",
    "notebook",
    "waffleiron",
)
TEST_SEQUENCES = tuple(f"arctic_s03_{name}_grab_01_1" for name in TEST_OBJECTS)
FOLDER = "arctic_preds"
# Predictions are tens of megabytes, and hundreds for large meshes.
_MAX_BYTES = 2048 * MIB


class SubmittedClip(NamedTuple):
    """What a submission says of one sequence."""

    sequence: str
    frames: int
    object_verts: int


def write_submission(
    path: str | Path,
    predictions: Sequence[Path],
    sequences: Sequence[str] = TEST_SEQUENCES,
    *,
    hold_class: bool = False,
) -> list[SubmittedClip]:
    """Pack prediction files into a submission, whole or not at all, and check it as `check_submission` does.

    Args:
        path: the zip to write.
        predictions: `<sequence>.pt` files, see `bigs.export.challenge`.
        sequences: those that the server wants.
        hold_class: name the dictionaries by HOLD's own class, `common.xdict.xdict`, for an evaluator that
            calls its methods. Such a file opens only where that class is, or by a reader that knows it.

    Raises:
        InputError: not exactly these sequences, or an invalid prediction.
    """
    _check_names(str(path), [file.stem for file in predictions], sequences)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(predictions):
            content = read_bytes(file, "a challenge prediction file", _MAX_BYTES)
            archive.writestr(
                f"{FOLDER}/{file.stem}.pt", _as_hold(str(file), content) if hold_class else content
            )
    found = _check_archive(str(path), buffer, sequences)
    with atomic_write(path) as target:
        target.write(buffer.getbuffer())
    return found


def check_submission(path: str | Path, sequences: Sequence[str] = TEST_SEQUENCES) -> list[SubmittedClip]:
    """Check every file name, key, shape and type that the server reads. Nothing in the files is run.

    Raises:
        InputError: the first thing that is wrong.
    """
    with open_regular(path, "a submission (a zip file)") as stream:
        return _check_archive(str(path), stream, sequences)


def _check_archive(where: str, stream: BinaryIO, sequences: Sequence[str]) -> list[SubmittedClip]:
    with open_zip(where, stream) as archive:
        members = [info for info in archive.infolist() if not info.is_dir()]
        for info in members:
            folder, _, name = info.filename.rpartition("/")
            if folder != FOLDER or not name.endswith(".pt"):
                raise InputError(f"{where}: expected only {FOLDER}/SEQUENCE.pt, found {shown(info.filename)}")
            if info.file_size > _MAX_BYTES:
                raise InputError(
                    f"{where}: {shown(info.filename)}: expected at most {_MAX_BYTES} bytes, found "
                    f"{info.file_size}"
                )
        names = [info.filename.removeprefix(f"{FOLDER}/").removesuffix(".pt") for info in members]
        _check_names(where, names, sequences)
        return [
            _check_prediction(f"{where}: {info.filename}", name, read_member(where, archive, info))
            for info, name in zip(members, names, strict=True)
        ]


def _check_names(where: str, names: Sequence[str], sequences: Sequence[str]) -> None:
    """Check that the files are exactly these sequences, each once."""
    missing = [name for name in sequences if name not in names]
    if missing:
        raise InputError(
            f"{where}: expected the {len(sequences)} sequences of the challenge, found no {missing[0]} "
            f"({len(missing)} missing)"
        )
    extra = [name for name in names if name not in sequences or names.count(name) > 1]
    if extra:
        raise InputError(
            f"{where}: expected only the challenge's sequences, each once, found {shown(extra[0])}"
        )


def _check_prediction(where: str, name: str, content: bytes) -> SubmittedClip:
    stored = validate_challenge(where, io.BytesIO(content))
    absent = [entity for entity in ENTITIES if f"root.{entity}" not in stored]
    if absent:
        raise InputError(f"{where}: expected both hands and the object, found no root.{absent[0]}")
    if stored["full_seq_name"] != name:
        raise InputError(f"{where}: full_seq_name: expected {name}, found {stored['full_seq_name']}")
    frames = stored["fnames"]
    for t, found in enumerate(frames):
        expected = f"./data/{name}/build/image/{t:04d}.png"
        if found != expected:
            raise InputError(f"{where}: fnames: expected {expected} as frame {t}, found {found}")
    return SubmittedClip(name, len(frames), stored["v3d_c.object"].shape[1])


class _HoldDictionary(dict[str, Any]):
    """Stands for `common.xdict.xdict` while a file is written."""


# The Python pickler: its way of writing a class's name can be changed.
_PythonPickler: Any = getattr(pickle, "_Pickler")  # noqa: B009


class _HoldPickler(_PythonPickler):
    """Writes the stand-in's name as that of HOLD's class, which need not be installed."""

    def save_type(self, obj: Any) -> None:
        if obj is _HoldDictionary:
            self.write(pickle.GLOBAL + b"common.xdict\nxdict\n")
            self.memoize(obj)
        else:
            super().save_type(obj)

    # Pickle looks up its methods by type.
    dispatch = _PythonPickler.dispatch | {type: save_type}


def _as_hold(where: str, content: bytes) -> bytes:
    """A prediction file whose dictionary is of HOLD's class."""
    stored = load_torch(where, io.BytesIO(content), "a challenge prediction")
    buffer = io.BytesIO()
    pickler: Any = SimpleNamespace(Pickler=_HoldPickler, __name__=pickle.__name__)
    torch.save(_HoldDictionary(stored), buffer, pickle_module=pickler)
    return buffer.getvalue()

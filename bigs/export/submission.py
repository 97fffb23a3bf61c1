"""`arctic_preds.zip`, what the ARCTIC bimanual category-agnostic challenge is sent: a file per sequence.

The server names no mistake, answers after hours and seldom, so everything that it reads is checked here.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch

from bigs.atomic import atomic_write
from bigs.checks import ARCHIVE_ERRORS, InputError, meant, neighbour, shown
from bigs.export.challenge import validate_challenge
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
# Predictions are tens of megabytes; more than this is a forged size.
_MAX_BYTES = 2 << 30


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
        InputError: not exactly these sequences, or a prediction that is not as it should be.
    """
    _check_names(str(path), [file.stem for file in predictions], sequences)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(predictions):
            if not file.is_file():
                raise InputError(f"{file}: expected a challenge prediction file, found no such file")
            content = file.read_bytes()
            archive.writestr(f"{FOLDER}/{file.stem}.pt", _as_hold(content) if hold_class else content)
    found = _check_archive(str(path), buffer, sequences)
    with atomic_write(path) as target:
        target.write(buffer.getbuffer())
    return found


def check_submission(path: str | Path, sequences: Sequence[str] = TEST_SEQUENCES) -> list[SubmittedClip]:
    """Check every file name, key, shape and type that the server reads. Nothing in the files is run.

    Raises:
        InputError: the first thing that is wrong.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(
            f"{path}: expected a submission (a zip file), found no such file{meant(neighbour(path))}"
        )
    return _check_archive(str(path), io.BytesIO(path.read_bytes()), sequences)


def _check_archive(where: str, buffer: io.BytesIO, sequences: Sequence[str]) -> list[SubmittedClip]:
    try:
        archive = zipfile.ZipFile(buffer)
    except zipfile.BadZipFile as error:
        raise InputError(f"{where}: expected a zip file, found {str(error).lower()}") from None
    with archive:
        members = [info for info in archive.infolist() if not info.is_dir()]
        for info in members:
            folder, _, name = info.filename.rpartition("/")
            if folder != FOLDER or not name.endswith(".pt"):
                raise InputError(f"{where}: expected only {FOLDER}/SEQUENCE.pt, found {shown(info.filename)}")
            if info.file_size > _MAX_BYTES:
                raise InputError(
                    f"{where}: {info.filename}: expected at most 2 GiB, found {info.file_size} bytes"
                )
        names = [info.filename.removeprefix(f"{FOLDER}/").removesuffix(".pt") for info in members]
        _check_names(where, names, sequences)
        return [
            _check_prediction(f"{where}: {info.filename}", name, _member(archive, where, info))
            for info, name in zip(members, names, strict=True)
        ]


def _member(archive: zipfile.ZipFile, where: str, info: zipfile.ZipInfo) -> bytes:
    try:
        return archive.read(info)
    except ARCHIVE_ERRORS as error:
        raise InputError(
            f"{where}: {info.filename}: expected a whole file, found a damaged one ({error})"
        ) from None


def _check_names(where: str, names: Sequence[str], sequences: Sequence[str]) -> None:
    """Exactly these sequences, each once."""
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


# The pickler in Python, whose way of writing a class's name can be changed.
_PythonPickler: Any = getattr(pickle, "_Pickler")  # noqa: B009


class _HoldPickler(_PythonPickler):
    """Writes the stand-in's name as that of HOLD's class, which need not be installed."""

    def save_type(self, obj: Any) -> None:
        if obj is _HoldDictionary:
            self.write(pickle.GLOBAL + b"common.xdict\nxdict\n")
            self.memoize(obj)
        else:
            super().save_type(obj)

    # Pickle looks its methods up by the type of what it writes.
    dispatch = _PythonPickler.dispatch | {type: save_type}


def _as_hold(content: bytes) -> bytes:
    """A prediction file whose dictionary is of HOLD's class."""
    stored = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    buffer = io.BytesIO()
    pickler: Any = SimpleNamespace(Pickler=_HoldPickler, __name__=pickle.__name__)
    torch.save(_HoldDictionary(stored), buffer, pickle_module=pickler)
    return buffer.getvalue()

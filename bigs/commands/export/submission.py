"""The challenge's submission from finished runs, and the check of one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bigs.checks import InputError
from bigs.export.submission import FOLDER, TEST_SEQUENCES, SubmittedClip, check_submission, write_submission


def submit(
    archive: Path, runs: Sequence[Path], sequences: Sequence[str] | None = None, *, hold_class: bool = False
) -> list[tuple[str, ...]]:
    """Pack the predictions of runs into a zip, or check the zip when there are no runs.

    Args:
        archive: the zip.
        runs: run folders, one for each sequence.
        sequences: those that the server wants; None is the challenge's nine.
        hold_class: see `write_submission`.

    Returns:
        A table of what the zip holds; its first row is the heading.

    Raises:
        InputError: the first thing that is wrong; no zip is written then.
    """
    wanted = TEST_SEQUENCES if sequences is None else tuple(sequences)
    found: list[SubmittedClip]
    if runs:
        files = [file for run in runs for file in _predictions(run)]
        found = write_submission(archive, files, wanted, hold_class=hold_class)
    else:
        found = check_submission(archive, wanted)
    rows = [(clip.sequence, str(clip.frames), str(clip.object_verts)) for clip in found]
    return [("sequence", "frames", "object vertices"), *rows]


def _predictions(run: Path) -> list[Path]:
    files = sorted((run / FOLDER).glob("*.pt"))
    if not files:
        raise InputError(f"{run / FOLDER}: expected the run's prediction file, found none")
    return files

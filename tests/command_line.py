"""Calling the program as a user does, and what its answers must look like."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple


class Answer(NamedTuple):
    """What came back from a call."""

    code: int
    out: str
    err: str


class Run(NamedTuple):
    """A finished `bigs reconstruct`."""

    folder: Path
    command: list[str]  # all arguments but --out
    answer: Answer


def run_bigs(*arguments: str | Path) -> Answer:
    """The command line in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "bigs.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )
    return Answer(done.returncode, done.stdout, done.stderr)


def assert_refused(answer: Answer, *words: str) -> None:
    """Not 0, nothing on stdout, and on stderr one sentence with `words` in this order.

    What was going on before may have been told, a line each.
    """
    assert answer.code != 0
    assert answer.out == ""
    *told, sentence = answer.err.splitlines()
    assert sentence.startswith("bigs: "), answer.err
    assert not any(line.startswith(("bigs: ", "Traceback", " ")) for line in told), answer.err
    position = 0
    for word in words:
        found = sentence.find(word, position)
        assert found >= 0, f"{word!r} not in {sentence!r}"
        position = found + len(word)


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}

"""What nobody foresaw ends in one sentence, and so does nothing where the output has no reader."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable

import pytest
from command_line import Answer


@pytest.mark.parametrize("arguments", [("--debug", "doctor"), ("doctor", "--debug"), ("doctor",)])
def test_an_error_that_nobody_foresaw(
    call: Callable[..., Answer], monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...]
) -> None:
    def fails() -> None:
        raise KeyError("a\nkey")

    monkeypatch.setattr("bigs.commands.doctor.examine", fails)
    answer = call(*arguments)
    assert (answer.code, answer.out) == (1, "")
    *traceback, sentence = answer.err.splitlines()
    for word in ("KeyError", "'a\\nkey'", "report", "--debug"):
        assert word in sentence
    assert any("Traceback" in line for line in traceback) == ("--debug" in arguments)


def test_an_integer_that_python_does_not_print(
    call: Callable[..., Answer], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails() -> None:
        str(10**5000)

    monkeypatch.setattr("bigs.commands.doctor.examine", fails)
    answer = call("doctor")
    assert answer.code == 1 and len(answer.err.splitlines()) == 1 and "ValueError" in answer.err


@pytest.mark.parametrize("closed", ["its reader has left", "it was never open"])
def test_an_output_that_nobody_reads(closed: str) -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "bigs.cli", "--version"]
    if closed == "it was never open":
        command = ["sh", "-c", '"$@" >&-', "sh", *command]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")

"""What nobody foresaw ends in one sentence, and so does nothing where the output has no reader."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Callable

import pytest
import torch
from command_line import Answer, assert_refused

from bigs.checks import InputError


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


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("std::bad_alloc"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        None,  # torch's own, of a tensor that no machine holds
    ],
)
def test_memory_that_cannot_be_had(
    call: Callable[..., Answer], monkeypatch: pytest.MonkeyPatch, error: Exception | None
) -> None:
    def fails() -> None:
        if error is None:
            torch.empty(1 << 60)
        else:
            raise error

    monkeypatch.setattr("bigs.commands.doctor.examine", fails)
    answer = call("doctor")
    assert (answer.code, answer.out) == (6, "")
    assert len(answer.err.splitlines()) == 1 and "expected enough memory" in answer.err


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


def test_no_text_of_a_file_steers_the_terminal(
    call: Callable[..., Answer], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails() -> None:
        raise InputError("a\nb\x1b[31m\u202e\ud800 :heart: [red] é" + "x" * 100_000)

    monkeypatch.setattr("bigs.commands.doctor.examine", fails)
    answer = call("doctor")
    assert answer.code == 2 and answer.err.count("\n") == 1 and len(answer.err) < 2000
    assert answer.err.startswith("bigs: a\\nb\\x1b[31m\\u202e\\ud800 :heart: [red] éxxx")
    monkeypatch.setattr("bigs.commands.doctor.examine", lambda: [("\x1b[31m :heart:", [])])
    assert call("doctor").out == "\\x1b[31m :heart::\n"


@pytest.mark.parametrize("threads", ["-1", "4097", "9" * 400])
def test_threads_that_no_machine_has(call: Callable[..., Answer], threads: str) -> None:
    assert_refused(call("render", "run", "--threads", threads), "--threads: expected 0 to 4096")

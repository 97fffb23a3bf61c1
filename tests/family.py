"""Programs in processes of their own, of which none outlives the test that started it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import uuid
from pathlib import Path
from typing import Any

import bigs

_PROC = Path("/proc")


class Family:
    """Starts programs; `end` kills what is left of them and of all that they started, daemons included.

    What was started is known by a variable that processes inherit and by their session. Where there is no
    /proc only the programs themselves are ended.
    """

    def __init__(self) -> None:
        self._name, self._value = "BIGS_TEST_FAMILY", uuid.uuid4().hex
        self._started: list[subprocess.Popen[Any]] = []

    def start(self, *command: str | Path, env: dict[str, str] | None = None, **options: Any) -> Any:
        """`subprocess.Popen` of a command."""
        environment = {**(os.environ if env is None else env), self._name: self._value}
        process = subprocess.Popen(
            list(map(str, command)), env=environment, start_new_session=True, **options
        )
        self._started.append(process)
        return process

    def start_bigs(self, *arguments: str | Path, env: dict[str, str] | None = None, **options: Any) -> Any:
        """The command line of the package under test."""
        package = str(Path(bigs.__file__).parents[1])
        given = {**os.environ, **({} if env is None else env)}
        given["PYTHONPATH"] = os.pathsep.join(filter(None, (given.get("PYTHONPATH"), package)))
        return self.start(sys.executable, "-m", "bigs.cli", *arguments, env=given, **options)

    def alive(self) -> list[int]:
        """Ids of all that still run."""
        found = {process.pid for process in self._started if process.poll() is None}
        sessions = {str(process.pid) for process in self._started}
        mark = f"{self._name}={self._value}".encode()
        for folder in _PROC.glob("[0-9]*"):
            # A process may end while it is looked at, and others' are not to be read.
            with contextlib.suppress(OSError):
                state, _, _, session = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
                inherits = mark in (folder / "environ").read_bytes().split(b"\0")
                if state != "Z" and (inherits or session in sessions):
                    found.add(int(folder.name))
        return sorted(found)

    def end(self) -> None:
        # Those that were about to start another one are there at the next look.
        while left := self.alive():
            for pid in left:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            for process in self._started:
                process.wait()
        for process in self._started:
            for stream in (process.stdin, process.stdout, process.stderr):
                if stream is not None:
                    stream.close()

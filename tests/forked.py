"""The program in processes that start at once: forked from one that has imported everything already.

Run as a program it reads one JSON line per process to start and answers with the process's id; an empty line
asks how it ended. Used as a module it has the class that talks to it.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import traceback
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import bigs

KILLED = -signal.SIGKILL


class Death(NamedTuple):
    """Where a process kills itself: at the `count`-th rename of a finished file, before it or after."""

    count: int
    renamed: bool


class Nursery:
    """Starts `bigs` again and again."""

    def __enter__(self) -> Nursery:
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(Path(bigs.__file__).parents[1])},  # the package under test
        )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()

    def start(self, *arguments: str | Path, output: Path, death: Death | None = None) -> int:
        """Start the command line, its words going to the file `output`; returns its process id."""
        order = {"arguments": list(map(str, arguments)), "output": str(output), "death": death}
        return self._ask(json.dumps(order))

    def lives(self, pid: int) -> bool:
        """Whether the process still works; one that has ended waits to be asked how."""
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"

    def ended(self) -> int:
        """Wait for the end; the exit code, or minus the signal. Until then the id is nobody else's."""
        return self._ask("")

    def _ask(self, line: str) -> int:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        assert line, "the nursery died"
        return int(line)


def _kill_at_rename(death: Death) -> None:
    rename, seen = os.replace, [0]

    def replace(*paths: Any) -> None:
        seen[0] += 1
        if seen[0] < death.count:
            return rename(*paths)
        if death.renamed:
            rename(*paths)
        return os.kill(os.getpid(), signal.SIGKILL)

    os.replace = replace


def _child(order: dict[str, Any]) -> int:
    from bigs.cli import main

    file = os.open(order["output"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(file, 1)
    os.dup2(file, 2)
    if order["death"]:
        _kill_at_rename(Death(*order["death"]))
    try:
        main(order["arguments"])
    except SystemExit as leave:
        return leave.code if isinstance(leave.code, int) else 1
    return 0


def _serve() -> None:
    import bigs.cli
    import bigs.commands.progress
    import bigs.commands.run.reconstruct  # noqa: F401

    with contextlib.suppress(ImportError):
        import av  # noqa: F401
    pid = 0
    for line in sys.stdin:
        if not line.strip():
            print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
            pid = 0
            continue
        pid = os.fork()
        if pid == 0:
            code = 70
            try:
                code = _child(json.loads(line))
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                os._exit(code)
        print(pid, flush=True)
    # Whoever asked is gone, so nobody needs what still works.
    if pid:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


if __name__ == "__main__":
    _serve()

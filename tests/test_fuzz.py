"""Some damaged files of every kind before the command line; `make fuzz` goes on for minutes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from command_line import Run

# Of each target. The whole takes half a minute of one core at most.
CASES = 4


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the sandbox needs Linux's limits and /proc")
def test_damaged_files_end_in_a_sentence_or_do_no_harm(tiny_clip: Path, finished_run: Run) -> None:
    command = ["-m", "fuzzing", "--cases", str(CASES), "--clip", tiny_clip, "--run", finished_run.folder]
    done = subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]

"""A process that uses COLMAP still ends when it is told to."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

WAIT = "import time; print('ready', flush=True); time.sleep(60)"


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
@pytest.mark.parametrize("module", ["bigs.colmap", "bigs.data.formats.sfm_folder", "bigs.motion.models"])
def test_a_process_that_is_terminated_says_nothing(module: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", f"import {module}; {WAIT}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate()
    assert process.returncode == -signal.SIGTERM
    assert errors == ""


def test_a_handler_of_ones_own_stays() -> None:
    script = (
        "import signal, sys, os; signal.signal(signal.SIGTERM, lambda *_: sys.exit(7)); import bigs.colmap; "
        "os.kill(os.getpid(), signal.SIGTERM); signal.pause()"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (7, "")

"""That nothing outlives a test is itself tested: with a daemon of a session of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from family import Family

DAEMON = """
import os, sys, time
if os.fork() == 0:
    os.setsid()
    print("at work", flush=True)
    time.sleep(600)
"""


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc")
def test_daemons_end_with_their_family() -> None:
    family = Family()
    try:
        parent = family.start(sys.executable, "-c", DAEMON, stdout=subprocess.PIPE, text=True)
        assert parent.stdout.readline() == "at work\n"
        assert parent.wait() == 0
        assert len(family.alive()) == 1
    finally:
        family.end()
    assert family.alive() == []

"""Folders that tests only read: made once, however many processes share the tests."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock


class MadeOnce:
    """Has a folder made by the first process that asks for it; the others wait until it is there."""

    def __init__(self, factory: pytest.TempPathFactory) -> None:
        own = factory.getbasetemp()
        # The folders of all processes of one session lie side by side.
        self._base = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own

    def __call__(self, name: str, make: Callable[[Path], Any]) -> tuple[Path, Any]:
        """The folder `name`, and what `make` returned when it filled it, as JSON keeps it.

        `make` is called with the path of a folder that is not there yet.
        """
        folder, answer = self._base / name, self._base / f"{name}.json"
        with FileLock(f"{folder}.lock"):
            if not answer.exists():
                shutil.rmtree(folder, ignore_errors=True)  # of a process that failed on the way
                answer.write_text(json.dumps(make(folder)))
            return folder, json.loads(answer.read_text())

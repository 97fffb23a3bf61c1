"""What many tests share: one tiny clip with known truth, and one finished run of it. Slow tests come last."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from bigs.data.base import Clip
from bigs.data.hold import load_hold
from bigs.data.synthetic import make_clip
from bigs.hand import HandModel, load_hand_models
from bigs.types import Side


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "slow: takes seconds; runs after everything else")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.get_closest_marker("slow") is not None)


class Run(NamedTuple):
    """A finished `bigs reconstruct`, as a user sees it."""

    folder: Path
    command: list[str]  # all arguments but --out
    stdout: str
    stderr: str
    code: int


def run_bigs(*arguments: str | Path, timeout: float = 120) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "bigs.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


@pytest.fixture(scope="session")
def both_hands() -> dict[Side, HandModel]:
    """The built-in hands."""
    return load_hand_models(None)


@pytest.fixture(scope="session")
def tiny_clip(tmp_path_factory: pytest.TempPathFactory, both_hands: dict[Side, HandModel]) -> Path:
    """12 frames of 120 x 90 of two hands and a bottle, with gt.npz. Read it, never write into it."""
    folder = tmp_path_factory.mktemp("tiny") / "clip"
    return make_clip(folder, hand_models=both_hands, frames=12, width=120, height=90, seed=1)


@pytest.fixture(scope="session")
def tiny(tiny_clip: Path) -> Clip:
    """The tiny clip, loaded."""
    return load_hold(tiny_clip)


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory, tiny_clip: Path) -> Run:
    """`bigs reconstruct` of the tiny clip with the smoke preset. Read it, never write into it."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    command = ["reconstruct", str(tiny_clip), "--preset", "smoke", "--gt", str(tiny_clip / "gt.npz")]
    done = run_bigs(*command, "--out", folder)
    return Run(folder, command, done.stdout, done.stderr, done.returncode)

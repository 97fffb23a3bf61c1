"""What many tests share: one tiny clip with known truth, and one finished run of it. Slow tests come last."""

from __future__ import annotations

import gc
import os
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from command_line import Answer, Run, run_bigs
from fake_runs import FakeRuns
from family import Family
from forked import Nursery
from made_once import MadeOnce

from bigs.cli import main
from bigs.data.base import Clip
from bigs.data.formats.hold import load_hold
from bigs.data.synthetic import make_clip
from bigs.hand import HandModel, load_hand_models
from bigs.types import Side

# Where several processes share the tests (pytest -n), each and what it starts works on one thread, or their
# threads would wait for each other. Both pools read this when they are first used.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("RAYON_NUM_THREADS", "1")
    torch.set_num_threads(1)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "slow: takes seconds; runs after everything else")
    # Modules and tests stay: the search for objects that only refer to each other takes a third of the
    # collection, and would go through all of them again and again while the tests run.
    gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.get_closest_marker("slow") is not None)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Why tests were skipped, a line for each reason."""
    skipped = terminalreporter.stats.get("skipped", [])
    reasons = Counter(str(report.longrepr[2]).removeprefix("Skipped: ") for report in skipped)
    for reason, count in reasons.most_common():
        terminalreporter.write_line(f"{count} skipped: {reason}")


@pytest.fixture(scope="session")
def both_hands() -> dict[Side, HandModel]:
    """The built-in hands."""
    return load_hand_models(None)


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> MadeOnce:
    """Makes folders that all processes of the session read."""
    return MadeOnce(tmp_path_factory)


@pytest.fixture(scope="session")
def tiny_clip(made_once: MadeOnce, both_hands: dict[Side, HandModel]) -> Path:
    """12 frames of 120 x 90 of two hands and a bottle, with gt.npz. Read it, never write into it."""

    def make(folder: Path) -> None:
        make_clip(folder / "clip", hand_models=both_hands, frames=12, width=120, height=90, seed=1)

    return made_once("tiny", make)[0] / "clip"


@pytest.fixture(scope="session")
def tiny(tiny_clip: Path) -> Clip:
    """The tiny clip, loaded."""
    return load_hold(tiny_clip)


@pytest.fixture(scope="session")
def finished_run(made_once: MadeOnce, tiny_clip: Path) -> Run:
    """`bigs reconstruct` of the tiny clip with the smoke preset. Read it, never write into it."""
    command = ["reconstruct", str(tiny_clip), "--preset", "smoke", "--gt", str(tiny_clip / "gt.npz")]
    folder, answer = made_once("finished", lambda folder: run_bigs(*command, "--out", folder / "run"))
    return Run(folder / "run", command, Answer(*answer))


@pytest.fixture(scope="session")
def nursery() -> Iterator[Nursery]:
    """Starts `bigs` in processes that need not import anything."""
    with Nursery() as nursery:
        yield nursery


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> FakeRuns:
    """Series of runs without runs."""
    fake = FakeRuns()
    monkeypatch.setattr("bigs.commands.run.series.reconstruct", fake)
    return fake


@pytest.fixture
def family() -> Iterator[Family]:
    """Starts programs and ends, with the test, what is left of them."""
    family = Family()
    yield family
    family.end()


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """Calls the command line in this process and returns its exit code and what it wrote."""

    def run(*arguments: str | Path) -> Answer:
        capsys.readouterr()
        code = 0
        try:
            main([str(argument) for argument in arguments])
        except SystemExit as leave:
            code = leave.code if isinstance(leave.code, int) else 1
        return Answer(code, *capsys.readouterr())

    return run

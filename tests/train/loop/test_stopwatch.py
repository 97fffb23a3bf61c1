"""Parts of a run's time add up to the whole."""

from __future__ import annotations

import pytest

from bigs.train.loop import stopwatch
from bigs.train.loop.stopwatch import Stopwatch


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(stopwatch.time, "perf_counter", lambda: now[0])
    return now


def test_every_second_belongs_to_a_part(clock: list[float]) -> None:
    watch = Stopwatch("loading")
    clock[0] += 2.0
    watch.begin("fit")
    clock[0] += 5.0
    assert watch.read() == {"loading": 2.0, "fit": 5.0}
    clock[0] += 1.0
    watch.begin("pictures")
    clock[0] += 3.0
    watch.begin("fit")
    clock[0] += 0.5
    assert watch.read() == {"loading": 2.0, "fit": 6.5, "pictures": 3.0}


def test_an_interrupted_run_counts_with_its_parts_first(clock: list[float]) -> None:
    watch = Stopwatch("loading")
    clock[0] += 2.0
    watch.begin("start values")
    clock[0] += 1.0
    watch.add({"loading": 4.0, "start values": 3.0, "coarse": 10.0})
    watch.begin("coarse")
    clock[0] += 7.0
    watch.begin("results")
    clock[0] += 1.0
    total = watch.read()
    assert total == {"loading": 6.0, "start values": 4.0, "coarse": 17.0, "results": 1.0}
    assert list(total) == ["loading", "start values", "coarse", "results"]


def test_a_pause_belongs_to_no_part(clock: list[float]) -> None:
    watch = Stopwatch("loading")
    clock[0] += 2.0
    with watch.paused():
        clock[0] += 100.0
    clock[0] += 1.0
    assert watch.read() == {"loading": 3.0}

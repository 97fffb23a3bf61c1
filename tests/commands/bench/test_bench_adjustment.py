"""`bigs bench adjustment`: its table, and that what it times is an adjustment."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from command_line import Answer


def test_costs_are_told_by_size(call: Callable[..., Answer], tmp_path: Path) -> None:
    plan = ("--frames", "8", "12", "--points", "60", "--seen", "0", "10", "--iterations", "6")
    assert call("bench", "adjustment", *plan, "--out", str(tmp_path)).code == 0
    runs = json.loads((tmp_path / "adjustment.json").read_text())["runs"]
    # Ten frames of eight are all of them.
    sizes = [(run["frames"], run["seen"], run["observations"]) for run in runs]
    assert sizes == [(8, 8, 480), (12, 12, 720), (12, 10, 600)]
    assert all(run["step_degrees"] < 0.3 for run in runs)
    assert "| 12 | 60 | 10 | 600 |" in (tmp_path / "adjustment.md").read_text()


def test_too_few_frames_are_refused(call: Callable[..., Answer], tmp_path: Path) -> None:
    answer = call("bench", "adjustment", "--frames", "2", "--out", str(tmp_path))
    assert answer.code != 0
    assert "--frames: expected 3 or more, found 2" in answer.err

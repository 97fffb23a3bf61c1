"""`bigs bench scale`: the clips it makes, their runs in processes of their own, and what it tells."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import Answer, assert_refused

from bigs.commands.bench import scale as module
from bigs.commands.bench.scale import ScalePlan, bench_scale, write_scaled
from bigs.commands.run.series import FinishedRun, PlannedRun
from bigs.data.base import Clip
from bigs.data.formats.hold import load_hold
from bigs.hand import HandModel
from bigs.types import Side


def test_a_longer_larger_clip_goes_to_and_fro(
    tiny: Clip, both_hands: dict[Side, HandModel], tmp_path: Path
) -> None:
    found = load_hold(write_scaled(tmp_path, tiny, both_hands, 15, (180, 135)))
    assert len(found) == 15 and (found.width, found.height) == (180, 135)
    np.testing.assert_allclose(found.K[:2], 1.5 * tiny.K[:2])
    at = [*range(12), 10, 9, 8]
    for side, track in tiny.hands.items():
        np.testing.assert_allclose(found.hands[side].transl, track.transl[at], atol=1e-6)
    np.testing.assert_allclose(found.object.points_world(), tiny.object.points_world()[at], atol=1e-5)
    # Of three pixels the last lies in the second of the two that they show.
    assert np.array_equal(found.mask(13)[2::3, 2::3], tiny.mask(9)[1::2, 1::2])


def test_runs_are_whole_measured_and_kept(tiny_clip: Path, tmp_path: Path) -> None:
    plan = ScalePlan(tiny_clip, (6,), (0.5,), "smoke")
    table, failed = bench_scale(plan, tmp_path)
    heading, row = table.rows
    assert failed == [] and row[:2] == ("6", "60 x 45")
    assert 0.2 < float(row[heading.index("peak, GiB")]) < 4.0
    assert (tmp_path / "6-frames-60x45" / "poses.npz").is_file()
    report = json.loads((tmp_path / "scale.json").read_text())
    assert report["runs"][0]["times"]["cpu"] > 0
    written = (tmp_path / "6-frames-60x45" / "memory.json").stat().st_mtime_ns
    assert bench_scale(plan, tmp_path)[0].rows == table.rows
    assert (tmp_path / "6-frames-60x45" / "memory.json").stat().st_mtime_ns == written


def test_a_run_that_fails_does_not_lose_the_others(
    monkeypatch: pytest.MonkeyPatch, tiny_clip: Path, tmp_path: Path
) -> None:
    class Here:
        def __init__(self, environment: dict[str, str]) -> None:
            self.environment = environment

        def run(self, function: Callable[[PlannedRun], str], run: PlannedRun) -> str:
            return function(run)

        def close(self) -> None:
            pass

    def fake(run: PlannedRun) -> FinishedRun:
        if run.folder.name.startswith("4"):
            return FinishedRun(failure="InputError: no light")
        stage = {"wall": 2.0, "cpu": 3.0}
        # Of an earlier call, which was interrupted before it wrote down the memory.
        return FinishedRun(
            reused=True, times={"wall": 4.0, "cpu": 6.0, "stages": {"joint": stage, "start values": stage}}
        )

    monkeypatch.setattr(module, "Worker", Here)
    monkeypatch.setattr(module, "run_or_reuse", fake)
    table, failed = bench_scale(ScalePlan(tiny_clip, (4, 5), (0.25,), "smoke"), tmp_path)
    assert failed == ["4-frames-30x22"]
    assert "no light" in table.rows[1][2] and table.rows[2][2:] == ("4", "6", "2", "2", "0", "-")


def test_what_the_command_line_refuses(call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert_refused(call("bench", "scale", tiny_clip, "--frames", "1", "--out", out), "--frames")
    assert_refused(call("bench", "scale", tiny_clip, "--enlarge", "0", "--out", out), "--enlarge")
    assert_refused(call("bench", "scale", tiny_clip / "build" / "image", "--out", out))
    assert not out.exists()

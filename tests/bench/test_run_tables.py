"""Tables and picture of `bigs bench reconstruct`: what they say of a report whose numbers are known."""

from __future__ import annotations

from typing import Any

import pytest

from bigs.bench.page import page
from bigs.bench.run_chart import draw_runs
from bigs.bench.run_tables import introduction, score, tables_of_runs

PHASES = ("fields", "engine")


def stage(steps: int, each: float, fields: float = 0.0) -> dict[str, Any]:
    """`steps` steps of `each` seconds, `fields` of them in fields and the same in the engine."""
    wall = steps * each + 1.0
    phases = dict.fromkeys(PHASES, steps * fields)
    rest = wall - 2 * steps * fields
    return {
        "wall": wall,
        "cpu": 2 * wall,
        "steps": steps,
        "in_steps": steps * each,
        "phases": phases,
        "rest": rest,
    }


def run(clip: str, label: str, error: float, stages: dict[str, Any], **more: Any) -> dict[str, Any]:
    wall = sum(s["wall"] for s in stages.values())
    steps = {name: s["steps"] for name, s in stages.items() if s["steps"]}
    return {
        "clip": clip,
        "label": label,
        "preset": "fast",
        "off": (),
        "nothing_of": (),
        "planned": steps,
        "steps": steps,
        "scores": {
            "initial": {"mpjpe_ra_h": 20.0, "f5_icp": 50.0},
            "result": {"mpjpe_ra_h": error, "f5_icp": 90.0, "psnr_foreground": 25.0},
        },
        "times": {"wall": wall, "cpu": 2 * wall, "resumed": False, "stages": stages},
        "skipped": [],
        "curve": [
            {"stage": name, "step": step, "wall": at, "cpu": 2 * at, "scores": {"mpjpe_ra_h": 20.0 - at}}
            for name, step, at in (("hands", 5, 0.5), ("hands", None, 1.0), ("joint", None, 3.0))
        ],
        "failure": "",
        "reused": False,
        **more,
    }


@pytest.fixture
def report() -> dict[str, Any]:
    stages = {"start values": stage(0, 0.0), "hands": stage(10, 0.1), "joint": stage(10, 0.2, fields=0.05)}
    less = {"start values": stage(0, 0.0), "joint": stage(8, 0.2, fields=0.05)}
    return {
        "machine": {"cpu": "CPU", "level": "avx2", "cores": 2, "system": "Linux", "load": 0.5},
        "bigs": "0",
        "torch": "2",
        "threads": 1,
        "clips": {name: {"frames": 6, "width": 80, "height": 60} for name in ("a", "b")},
        "runs": [
            run("a", "fast", 10.0, stages),
            run("b", "fast", 12.0, stages),
            run(
                "a",
                "paper (20 of 2000 steps)",
                19.0,
                stages,
                preset="paper",
                planned={"hands": 1000, "joint": 1000},
            ),
            run(
                "a",
                "fast without contact",
                10.5,
                less,
                off=("contact",),
                steps={"joint": 10},
                planned={"joint": 10},
                skipped=["joint: 2 of 10 steps, the loss had settled (0.4 s saved)"],
            ),
            run("b", "fast without contact", 0.0, {}, off=("contact",), failure="OSError: disk full"),
        ],
        "growth": [],
    }


def by_title(report: dict[str, Any]) -> dict[str, list[tuple[str, ...]]]:
    return {table.title: table.rows for table in tables_of_runs(report)}


def test_means_and_what_a_whole_run_would_take(report: dict[str, Any]) -> None:
    rows = {row[0]: row[1:] for row in by_title(report)["Time and errors"]}
    assert rows[""] == ("initial estimates", "fast", "paper (20 of 2000 steps)", "fast without contact")
    assert rows["clips"] == ("2", "2", "1", "1")
    assert rows["wall s"] == ("", "6.0", "6.0", "3.6")
    # Of 6 seconds 3 are steps, of which there would be a hundred times as many.
    assert rows["all steps s"] == ("", "", "303", "")
    assert rows["steps/s"] == ("", "6.67", "6.67", "5.00")
    assert rows["MPJPE mm"] == ("20.00", "11.00", "19.00", "10.50")
    assert rows["wrist mm"] == ("-", "-", "-", "-")
    assert rows["PSNR dB"] == ("-", "25.00", "25.00", "25.00")


def test_a_switch_is_compared_clip_by_clip(report: dict[str, Any]) -> None:
    """The clip on which it failed counts on neither side."""
    rows = {row[0]: row[1:] for row in by_title(report)["Switches"]}
    assert rows[""] == ("fast without contact",)
    assert (rows["wall s"], rows["MPJPE mm"]) == (("-2.4",), ("+0.50",))


def test_where_the_time_goes(report: dict[str, Any]) -> None:
    tables = by_title(report)
    assert ("fast", "joint", "3.00", "6.00", "10", "200.0") in tables["Stages"]
    assert ("fast", "start values", "1.00", "2.00", "", "") in tables["Stages"]
    heading, first, second, *_ = tables["Where a step's time goes"]
    assert heading == ("run", "stage", "fields", "engine", "rest", "sum")
    assert first == ("fast", "hands", "0.0", "0.0", "200.0", "200.0")
    assert second == ("fast", "joint", "50.0", "50.0", "200.0", "300.0")


def test_scores_along_a_run(report: dict[str, Any]) -> None:
    """The ends of stages; a run without times has none."""
    report["runs"][1]["times"]["resumed"] = True
    _, *rows = by_title(report)["Along the runs"]
    assert [row[:6] for row in rows if row[0] == "fast"] == [
        ("fast", "a", "hands", "2.0", "1.0", "19.00"),
        ("fast", "a", "joint", "6.0", "3.0", "17.00"),
    ]


def test_what_was_saved(report: dict[str, Any]) -> None:
    rows = by_title(report)["Work left out"]
    assert ("fast", "a", "fields in 10 steps of hands, at the 50.0 ms of joint", "0.5") in rows
    assert rows[-1] == (
        "fast without contact",
        "a",
        "joint: 2 of 10 steps, the loss had settled (0.4 s saved)",
        "0.4",
    )


def test_a_run_that_was_interrupted_has_no_time(report: dict[str, Any]) -> None:
    report["runs"][0]["times"]["resumed"] = True
    report["runs"][0]["times"]["wall"] = 0.1
    tables = by_title(report)
    rows = {row[0]: row[1:] for row in tables["Time and errors"]}
    assert rows["wall s"][1] == "6.0" and rows["MPJPE mm"][1] == "11.00"
    assert {row[0]: row[1:] for row in tables["Switches"]}["wall s"] == ("-",)
    assert tables["Failed or not timed"][1:] == [
        ("b", "fast without contact", "OSError: disk full"),
        ("a", "fast", "not timed: continued after an interruption (remove its folder to time it)"),
    ]


def test_growth(report: dict[str, Any]) -> None:
    report["growth_of"] = {"clip": "a", "label": "fast", "steps": 6}
    report["growth"] = [
        {
            "axis": "frames",
            "value": str(frames),
            "frames": frames,
            "gaussians": 100,
            "pixels": 4800,
            "start": 1.0,
            "searches": {},
            "stages": {"joint": 10.0 * frames},
            "total": 7.0,
        }
        for frames in (15, 30)
    ]
    assert by_title(report)["Growth"][1:] == [
        ("frames", "15", "15", "100", "4800", "1.0", "7", "150.0"),
        ("frames", "30", "30", "100", "4800", "1.0", "7", "300.0"),
    ]


def test_one_hand_stands_for_both() -> None:
    assert score({"mpjpe_ra_h": 1.0, "mpjpe_ra_l": 2.0}, "mpjpe_ra_h") == 1.0
    assert score({"mpjpe_ra_l": 2.0}, "mpjpe_ra_h") == 2.0
    assert score({"cd_r_sq": 3.0}, "cd_h_sq") == 3.0
    assert score({"wrist_l": 4.0, "f5_icp": 5.0}, "f5_icp") == 5.0
    assert score({}, "wrist_h") is None


def test_the_page(report: dict[str, Any]) -> None:
    tables = tables_of_runs(report)
    text = page("bigs bench reconstruct", introduction(report), tables)
    assert "a (6 frames, 80 x 60), b (6 frames, 80 x 60)" in text and "1 threads" in text
    for table in tables:
        assert f"\n## {table.title}\n" in text
        assert {len(cells) for cells in table.rows} == {len(table.rows[0])}
    # Nothing finished, nothing to show but why.
    report["runs"] = report["runs"][-1:]
    assert list(by_title(report)) == ["Failed or not timed"]


def test_the_picture(report: dict[str, Any]) -> None:
    pytest.importorskip("matplotlib")
    full = draw_runs(report)
    assert full.startswith(b"\x89PNG") and len(full) < 200_000
    assert draw_runs(report, "cpu") != full
    lines = [run["curve"] for run in report["runs"]]
    for run in report["runs"]:
        run["curve"] = []
    assert len(draw_runs(report)) < len(full) and all(lines)
    report["runs"] = []
    assert len(draw_runs(report)) < len(full)

"""Tables and picture of a report: they say what was measured and nothing that was not."""

from __future__ import annotations

import math

import pytest

from bigs.bench.chart import draw_curve
from bigs.bench.engine import FLOPS_BACKWARD, FLOPS_FORWARD
from bigs.bench.tables import markdown, tables_of


def row(part: str, label: str, cpu: float, threads: int = 1, **more) -> dict:
    times = {"forward_cpu": cpu / 4, "backward_cpu": 3 * cpu / 4, "cpu": cpu}
    walls = {"forward_wall": cpu / 4, "backward_wall": 3 * cpu / 4, "wall": cpu / threads}
    walls |= {"fastest_cpu": 0.9 * cpu, "fastest_wall": 0.9 * cpu / threads}
    return {
        "part": part,
        "label": label,
        "threads": threads,
        "level": "avx2",
        "runs": 3,
        **times,
        **walls,
        **more,
    }


def errors(value: float) -> dict[str, float]:
    return {"image": value / 10, "means": value, "quats": math.nan, "colors": value / 2}


@pytest.fixture
def report() -> dict:
    by_rule = {"exact": errors(0.25), "every_pair": errors(0.5)}
    return {
        "machine": {"system": "Test", "cpu": "a CPU", "cores": 2, "level": "avx2", "load": 0.0},
        "bigs": "0",
        "torch": "0",
        "workloads_from": "seed 0",
        "scale": 1.0,
        "repeats": 3,
        "seconds": 1.0,
        "peaks": {"avx2": 100.0, "baseline": 40.0},
        "peers": {
            "gsplat": {"version": "9", "install": "pip install gsplat", "note": "slow"},
        },
        "workloads": {
            "A": {
                "text": "a scene",
                "gaussians": 60,
                "width": 8,
                "height": 5,
                "pairs": 1_000_000,
                "times": [
                    row("times", "bigs", 4.0),
                    row("times", "bigs", 4.4, threads=2),
                    row("levels", "baseline", 10.0, **by_rule) | {"level": "baseline"},
                    row("peers", "gsplat", 400.0, **by_rule),
                ],
                "errors": {"float32 against float64": errors(1e-6)},
                "peers_left_out": {},
                "stages": {
                    "project": 1.0,
                    "bin": 0.5,
                    "composite": 0.7,
                    "composite vjp": 1.9,
                    "project vjp": 0.4,
                    "forward": 2.0,
                    "backward": 3.0,
                    "torch forward": 2.5,
                    "torch backward": 3.5,
                },
                "memory": {"bigs": 1e6},
                "skips": [
                    {
                        "label": "half of it",
                        "work": 1.0,
                        "with": row("skips", "half of it, with", 2.0),
                        "without": row("times", "bigs", 4.0),
                        "counters_with": {"n_isects": 5, "n_visible": 3},
                        "counters_without": {"n_isects": 9, "n_visible": 3},
                    }
                ],
                "curve": [
                    {
                        "group": "dtype",
                        "label": "dtype float32",
                        "cpu": 4.0,
                        "wall": 4.0,
                        "default": True,
                        **by_rule,
                    },
                    {
                        "group": "dtype",
                        "label": "dtype float64",
                        "cpu": 6.0,
                        "wall": 6.0,
                        "default": False,
                        **by_rule,
                    },
                ],
            }
        },
    }


def test_tables_say_what_was_measured(report: dict) -> None:
    tables = {table.title: table.rows for table in tables_of(report)}
    ns = 1.0, 3.0  # milliseconds of a million pairs
    share = " / ".join(f"{f / n:.0f}" for f, n in zip((FLOPS_FORWARD, FLOPS_BACKWARD), ns, strict=True))
    assert tables["Times"][1][:8] == ("A", "1", "1", "3", "4", "3.6", "4", "3.6")
    assert tables["Times"][1][8:] == ("1.00", "1.00 / 3.00", share)
    assert tables["Times"][2][8] == "1.82"
    assert tables["Instruction levels"][2] == ("A", "baseline", "2.5", "7.5", "10", "2.50", "2.5e-01")
    assert tables["Stages, and what torch adds"][1][6:] == ("0.70 / 1.90", "50 / 30", "5", "6", "1.20")
    assert tables["Memory"][1] == ("A", "bigs", "1", "10000")
    assert tables["Peers"][3][:2] == ("A", "gsplat")
    assert tables["Peers"][3][7] == "100 / 100"
    assert tables["Work left out"][1][2:] == ("4", "2", "2.00", "2.00", "2.00", "n_isects 9 to 5")
    assert tables["Time against error"][1] == (
        "A", "dtype float32 (default)", "4", "2.5e-02", "2.5e-01", "5.0e-02", "5.0e-01"
    )  # fmt: skip


def test_a_wrong_gradient_shows(report: dict) -> None:
    """Whoever is fast and wrong has both in the same report."""
    rows = next(table.rows for table in tables_of(report) if table.title == "Errors")
    assert rows[2] == ("A", "gsplat against float64", "2.5e-02", "2.5e-01", "(zero)", "", "", "1.2e-01")


def test_a_peer_that_is_missing_says_how_to_get_it(report: dict) -> None:
    workload = report["workloads"]["A"]
    workload["times"] = [r for r in workload["times"] if r["part"] != "peers"]
    workload["peers_left_out"] = {"gsplat": "not installed (pip install gsplat)"}
    rows = next(table.rows for table in tables_of(report) if table.title == "Peers")
    assert rows[-1] == ("A", "gsplat: not installed (pip install gsplat)", *("",) * 7)


def test_what_was_not_measured_has_no_table(report: dict) -> None:
    for key in ("stages", "memory", "skips", "curve"):
        del report["workloads"]["A"][key]
    report["peers"] = {}
    report["workloads"]["A"]["times"] = report["workloads"]["A"]["times"][:2]
    assert [table.title for table in tables_of(report)] == ["Times", "Errors"]


def test_the_page_is_a_table_for_each(report: dict) -> None:
    tables = tables_of(report)
    page = markdown(report, tables)
    for table in tables:
        assert f"\n## {table.title}\n" in page
        assert {len(cells) for cells in table.rows} == {len(table.rows[0])}
    assert page.count("\n| --- |") == len(tables)


def test_the_picture_is_small(report: dict) -> None:
    pytest.importorskip("matplotlib")
    picture = draw_curve(report)
    assert picture.startswith(b"\x89PNG")
    assert 5_000 < len(picture) < 150_000

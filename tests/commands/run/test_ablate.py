"""The paper's Table 3 on a clip: which rows there are, what they cost to repeat, and one that fails."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import Answer, assert_refused
from fake_runs import FakeRuns, idle_switch

from bigs.checks import InputError
from bigs.commands.folder.contents import CONFIG
from bigs.commands.run.ablate import Row, ablate, default_rows, parse_rows
from bigs.train.plan.config_file import load_config
from bigs.train.plan.presets import PRESETS
from bigs.train.resolve import resolve

SMOKE = PRESETS["smoke"]


def test_the_papers_rows() -> None:
    joined = ["prior+contact", "prior+contact+smooth", "prior+contact+smooth+share"]
    assert default_rows() == ["prior", "contact", "smooth", "share", *joined]
    papers = {row.name: row.paper for row in parse_rows(default_rows())}
    # CD_l, CD_r, CD_o, F10, MPJPE_l, MPJPE_r; the paper takes its ingredients away one after the other.
    assert papers == {
        "full": (46.11, 31.28, 1.28, 83.93, 24.63, 24.35),
        "prior": (50.78, 35.57, 1.36, 81.78, 24.63, 24.35),
        "contact": None,
        "smooth": None,
        "share": None,
        "prior+contact": (83.14, 96.95, 1.36, 81.78, 24.63, 24.35),
        "prior+contact+smooth": (96.55, 117.72, 1.36, 81.78, 27.01, 24.42),
        "prior+contact+smooth+share": (96.56, 117.72, 1.36, 81.78, 27.22, 25.08),
    }


def test_rows_as_they_are_asked_for() -> None:
    assert parse_rows(["share,lighting", "smooth+contact", "contact+smooth", "full"]) == [
        Row(()),
        Row(("share",)),
        Row(("lighting",)),
        Row(("smooth", "contact")),
    ]
    with pytest.raises(InputError, match=r"--rows share\+blur: expected one of full, share, .*'blur'"):
        parse_rows(["share+blur"])


def test_each_row_is_run_without_its_ingredients(runs: FakeRuns, tiny_clip: Path, tmp_path: Path) -> None:
    idle = idle_switch(SMOKE)
    found = ablate(tiny_clip, tmp_path / "out", SMOKE, ["prior+contact+smooth", idle])
    assert runs.made == ["full", "prior+contact+smooth", idle] and found.failed == []
    assert load_config(tmp_path / "out" / "full" / CONFIG) == resolve(SMOKE).config
    less = load_config(tmp_path / "out" / "prior+contact+smooth" / CONFIG)
    assert less.initial.smooth_hands == 0.0
    assert not any("contact" in stage.weights for stage in less.stages if hasattr(stage, "weights"))

    rows = found.table.rows
    assert rows[0][:3] == ("without", "CD_l cm²", "CD_r cm²")
    assert [row[0] for row in rows[1:]] == [
        "nothing",
        "(the paper)",
        "prior + contact + smooth",
        "(the paper)",
        idle,
        "initial estimates",
    ]
    assert rows[1][1:7] == ("2.50", "0.50", "0.50", "97.50", "8.00", "9.00")
    assert rows[2][1] == "46.11" and rows[4][1] == "96.55"
    assert rows[3][2] == "2.50" and rows[6][2] == "1.50"
    assert "datasets differ" in found.table.note
    assert f"{idle}: this plan does not contain {idle}." in found.table.note

    page = (tmp_path / "out" / "ablation.md").read_text()
    assert page.count("| (the paper) |") == 2 and "datasets differ" in page
    numbers = {
        row["row"]: row for row in json.loads((tmp_path / "out" / "ablation.json").read_text())["rows"]
    }
    assert list(numbers) == ["full", "prior+contact+smooth", idle]
    assert numbers["full"]["paper"]["cd_l_sq"] == 46.11
    assert numbers["full"]["scores"]["result"]["cd_r_sq"] == 0.5
    assert numbers["full"]["times"]["stages"]["joint"]["steps"] == 1
    assert numbers["full"]["skipped"] == ["joint: 1 of 2 steps, the loss had settled (0.4 s saved)"]


def test_a_row_that_fails_and_a_rerun(runs: FakeRuns, tiny_clip: Path, tmp_path: Path) -> None:
    runs.fail = "share"
    found = ablate(tiny_clip, tmp_path / "out", SMOKE, ["share", "smooth"])
    assert found.failed == ["share"]
    assert ("share", *("",) * 7) in found.table.rows
    assert "share failed: FloatingPointError: stage joint, step 1" in found.table.note
    (other,) = [row for row in found.table.rows if row[0] == "smooth"]
    assert other[2] == "0.75"

    runs.fail, runs.made = None, []
    again = ablate(tiny_clip, tmp_path / "out", SMOKE, ["share", "smooth"])
    assert runs.made == ["share"] and again.failed == []
    assert "failed" not in again.table.note
    # It went on from its checkpoint: what that took does not say what the row costs.
    assert "share: continued after an interruption, not timed." in again.table.note
    assert {row[0]: row[-1] for row in again.table.rows[1:]} == {
        "nothing": "0", "(the paper)": "", "share": "-", "smooth": "0", "initial estimates": ""
    }  # fmt: skip
    assert [row for row in again.table.rows if row[0] == "smooth"] == [other]


def test_a_folder_of_other_runs_is_refused(runs: FakeRuns, tiny_clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    ablate(tiny_clip, out, SMOKE, ["share"])
    with pytest.raises(InputError, match=r"full.config\.yaml: expected the configuration of this run"):
        ablate(tiny_clip, out, replace(SMOKE, seed=1), ["share"])
    with pytest.raises(InputError, match=r"config\.yaml: hand_model: expected .*hands, found None"):
        ablate(tiny_clip, out, SMOKE, ["share"], hand_model=tmp_path / "hands")
    assert runs.made == ["full", "share"]


def test_what_the_command_line_says(
    runs: FakeRuns, call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    assert_refused(call("ablate", tiny_clip, "--out", out, "--rows", "blur"), "--rows blur", "found 'blur'")
    assert_refused(call("ablate", tiny_clip / "build", "--out", out, "--gt", tmp_path), "gt.npz")
    assert not out.exists()
    runs.fail = "share"
    answer = call("ablate", tiny_clip, "--out", out, "--preset", "smoke", "--rows", "share", "smooth")
    assert answer.code == 5
    assert "1 failed (share); the others are kept" in answer.err
    assert "datasets differ" in answer.out
    assert load_config(out / "full" / CONFIG) == resolve(SMOKE).config
    runs.fail = None
    assert call("ablate", tiny_clip, "--out", out, "--preset", "smoke", "--rows", "share,smooth").code == 0


@pytest.mark.slow
def test_a_real_row(tiny_clip: Path, tmp_path: Path) -> None:
    """A plan of two short stages, with its scores and times."""
    stages = [
        replace(stage, steps=2) for stage in SMOKE.stages if stage.name in ("hands-coarse", "appearance")
    ]
    found = ablate(tiny_clip, tmp_path / "out", replace(SMOKE, stages=tuple(stages)), [])
    assert found.failed == []
    (row,) = json.loads((tmp_path / "out" / "ablation.json").read_text())["rows"]
    assert row["scores"]["result"]["mpjpe_ra_r"] > 0
    assert list(row["times"]["stages"]) == ["start values", "hands-coarse", "appearance", "outputs"]
    assert row["times"]["stages"]["appearance"]["phases"]["engine backward"] > 0
    assert row["times"]["wall"] == pytest.approx(sum(s["wall"] for s in row["times"]["stages"].values()))

"""`bigs bench reconstruct`: which runs and probes there are, what is kept, and what is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from command_line import Answer, Run, assert_refused
from fake_runs import FakeRuns, idle_switch

from bigs.checks import InputError
from bigs.commands.bench.growth import Probe, measure, probes
from bigs.commands.bench.reconstruct import RunPlan, bench_reconstruct, variants
from bigs.commands.folder.contents import CONFIG, SCENE
from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.metrics import align
from bigs.train.plan.config import OptimizeStage
from bigs.train.plan.config_file import load_config
from bigs.train.plan.length import planned_steps
from bigs.train.plan.presets import PRESETS
from bigs.train.resolve import resolve
from bigs.types import Side

SMOKE = PRESETS["smoke"]


def test_variants() -> None:
    idle = idle_switch(SMOKE)
    plan = RunPlan((), ("smoke", "paper", "smoke"), ("share", f"{idle}+smooth"), steps_limit=750)
    found = variants(plan)
    assert [v.label for v in found] == [
        "smoke",
        "paper (750 of 75000 steps)",
        "smoke without share",
        f"smoke without {idle}, smooth",
    ]
    assert found[1].folder == "paper-750-steps"
    assert planned_steps(found[1].config) == {"hands": 150, "object": 300, "translations": 300}
    assert found[1].whole == PRESETS["paper"]
    assert not found[2].config.hand.shared
    assert found[3].unused == (idle,)
    assert len({v.folder for v in found}) == len(found)


def test_probes(tiny: Clip) -> None:
    found = probes(tiny, SMOKE, (5, 30))
    assert [(p.axis, p.frames) for p in found[:2]] == [("frames", 5), ("frames", 30)]
    gaussians = [p.config for p in found if p.axis == "Gaussians"]
    assert [c.object.n_gaussians for c in gaussians] == [150, 600, 2400]
    assert [c.hand.subdivisions for c in gaussians] == [0, 0, 1]
    sizes = [
        [stage.image_size for stage in p.config.stages if isinstance(stage, OptimizeStage)]
        for p in found
        if p.axis == "image size"
    ]
    # The clip is 120 pixels wide.
    assert [size[0] for size in sizes] == [30, 60, 120]
    assert [size[1] for size in sizes] == [40, 80, 120]
    assert [p.config for p in found if p.value == "1"] == [SMOKE, SMOKE]


@pytest.mark.slow
def test_a_probe(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    stages = [stage for stage in SMOKE.stages if stage.name in ("hands-coarse", "grasps", "joint")]
    config = replace(SMOKE, stages=tuple(stages))
    found = measure(tiny, both_hands, Probe("frames", "14", 14, config), 2)
    assert found["frames"] == 14
    assert list(found["stages"]) == ["hands-coarse", "joint"]
    assert list(found["searches"]) == ["grasps", "object mesh"]
    # Two hands of 778 Gaussians, and an object of 600 at least.
    assert found["gaussians"] >= 2 * 778 + 600
    milliseconds = sum(planned_steps(config)[name] * ms for name, ms in found["stages"].items())
    assert found["total"] == pytest.approx(
        found["start"] + sum(found["searches"].values()) + 1e-3 * milliseconds
    )


@pytest.mark.slow
def test_a_curve(finished_run: Run, tiny_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scores along the run, whose result is that of a run that nothing watches."""
    # How well shapes are aligned is not asked here, and each point of the curve asks for one.
    monkeypatch.setattr(align, "_COARSE_ITERATIONS", 2)
    monkeypatch.setattr(align, "_FINE_ITERATIONS", 2)
    plan = RunPlan((tiny_clip,), ("smoke",), curve_every=0.1, growth_steps=0)
    assert bench_reconstruct(plan, tmp_path, picture=False).failed == []
    (run,) = json.loads((tmp_path / "reconstruct.json").read_text())["runs"]
    points, times = run["curve"], run["times"]
    scene = (tmp_path / "clip" / "smoke" / SCENE).read_bytes()
    assert scene == (finished_run.folder / SCENE).read_bytes()

    ends = [point["stage"] for point in points if point["step"] is None]
    assert ends == [name for name in times["stages"] if name != "outputs"]
    within = [point for point in points if point["step"] is not None]
    assert len(within) >= 3
    assert all(0 < point["step"] <= times["stages"][point["stage"]]["steps"] for point in within)
    for clock in ("wall", "cpu"):
        seconds = [point[clock] for point in points]
        assert seconds == sorted(seconds) and seconds[0] > 0.0 and seconds[-1] < times[clock]
    # What took longer than the whole run did is not part of it.
    assert sum(stage["in_steps"] for stage in times["stages"].values()) < points[-1]["wall"]
    keys = {"mpjpe_ra_h", "wrist_h", "cd_h_sq", "cd_icp_sq", "f5_icp", "psnr_foreground"}
    assert all(keys <= set(point["scores"]) for point in points)
    # All frames of so short a clip are scored, as they are in the end.
    last, result = points[-1]["scores"], run["scores"]["result"]
    assert last["mpjpe_ra_h"] == pytest.approx(result["mpjpe_ra_h"])
    assert last["psnr_foreground"] == pytest.approx(result["psnr_foreground"])
    assert last["mpjpe_ra_h"] < points[0]["scores"]["mpjpe_ra_h"]


@pytest.fixture
def two_clips(tiny_clip: Path, tmp_path: Path) -> tuple[Path, Path]:
    """The tiny clip, and the same without its truth."""
    other = tmp_path / "other"
    shutil.copytree(tiny_clip / "build", other / "build")
    return tiny_clip, other / "build"


def test_runs_and_probes_are_kept(
    runs: FakeRuns, two_clips: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    probed: list[str] = []

    def fake(clip: Clip, models: object, probe: Probe, steps: int) -> dict[str, Any]:
        probed.append(f"{probe.axis} {probe.value}")
        point = {"frames": probe.frames, "gaussians": 9, "pixels": 9, "start": 1.0, "total": 2.0}
        return {**point, "searches": {}, "stages": {"joint": 3.0}}

    monkeypatch.setattr("bigs.commands.bench.reconstruct.measure", fake)
    out = tmp_path / "out"
    plan = RunPlan(two_clips, ("smoke",), ("share",), frames=(5,), growth_steps=2)
    runs.fail = "smoke-without-share"
    found = bench_reconstruct(plan, out, picture=False)
    assert found.failed == ["clip: smoke without share", "other: smoke without share"]
    assert runs.made == ["smoke", "smoke-without-share"] * 2
    assert load_config(out / "other" / "smoke" / CONFIG) == resolve(SMOKE).config
    assert len(probed) == 7

    runs.fail, runs.made, probed[:] = None, [], []
    again = bench_reconstruct(replace(plan, frames=(5, 6)), out, picture=False)
    assert again.failed == []
    assert runs.made == ["smoke-without-share"] * 2
    assert probed == ["frames 6"]
    numbers = json.loads((out / "reconstruct.json").read_text())
    assert [run["reused"] for run in numbers["runs"]] == [True, False, True, False]
    assert [point["axis"] for point in numbers["growth"]] == [
        *["frames"] * 2,
        *["Gaussians"] * 3,
        *["image size"] * 3,
    ]
    page = (out / "reconstruct.md").read_text()
    assert [table.title for table in again.tables] == [
        line[3:] for line in page.splitlines() if line.startswith("## ")
    ]
    # Other steps of growth are other measurements.
    bench_reconstruct(replace(plan, growth_steps=3), out, picture=False)
    assert "frames 5" in probed


def test_runs_of_earlier_calls_stay_in_the_tables(
    runs: FakeRuns, two_clips: tuple[Path, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"

    def listed(plan: RunPlan) -> list[tuple[str, str]]:
        bench_reconstruct(plan, out, picture=False)
        numbers = json.loads((out / "reconstruct.json").read_text())
        assert set(numbers["clips"]) >= {run["clip"] for run in numbers["runs"]}
        return [(run["clip"], run["label"]) for run in numbers["runs"]]

    smoke = RunPlan(two_clips, ("smoke",), growth_steps=0)
    assert listed(smoke) == [("clip", "smoke"), ("other", "smoke")]
    share = replace(smoke, clips=two_clips[:1], without=("share",))
    assert listed(share) == [("other", "smoke"), ("clip", "smoke"), ("clip", "smoke without share")]
    # A folder that was removed is no run any more, and one that failed never was.
    shutil.rmtree(out / "other")
    runs.fail = "smoke-without-contact"
    assert ("clip", "smoke without contact") in listed(replace(share, without=("contact",)))
    assert listed(replace(share, without=())) == [("clip", "smoke without share"), ("clip", "smoke")]


def test_what_the_command_line_says(
    runs: FakeRuns, call: Callable[..., Answer], two_clips: tuple[Path, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    options = ["--out", out, "--presets", "smoke", "--growth-steps", "0", "--no-picture"]
    answer = call("bench", "reconstruct", *two_clips, *options)
    assert answer.code == 0, answer.err
    titles = ["Time and errors", "Where a step's time goes", "Switches"]
    assert [title for title in titles if title in answer.out] == titles[:1]
    assert list((out / "clip").iterdir()) == [out / "clip" / "smoke"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("", ["CLIP", "expected at least one"]),
        ("CLIP CLIP", ["CLIP", "different names", "found clip twice"]),
        ("CLIP --presets turbo", ["turbo", "--presets", "smoke"]),
        ("CLIP --presets smoke --without blur", ["--without", "share", "found 'blur'"]),
        ("CLIP --presets smoke --steps-limit -1", ["--steps-limit", "found -1"]),
        ("CLIP --presets smoke --growth-steps -1", ["--growth-steps", "found -1"]),
        ("CLIP --presets smoke --curve-every -2", ["--curve-every", "found -2"]),
        ("CLIP --presets smoke --frames 1", ["--frames", "at least 2", "found 1"]),
        ("CLIP --presets", ["--presets"]),
        ("NOWHERE --presets smoke", ["nowhere", "expected a clip"]),
    ],
)
def test_options_that_cannot_be(
    call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path, options: str, words: list[str]
) -> None:
    places = {"CLIP": tiny_clip, "NOWHERE": tmp_path / "nowhere"}
    chosen = [places.get(word, word) for word in options.split()]
    answer = call("bench", "reconstruct", *chosen, "--out", tmp_path / "out", "--no-picture")
    assert_refused(answer)
    assert all(word in answer.err for word in words), answer.err
    assert not (tmp_path / "out").exists()


def test_a_folder_of_other_runs_is_refused(runs: FakeRuns, tiny_clip: Path, tmp_path: Path) -> None:
    plan = RunPlan((tiny_clip,), ("smoke",), growth_steps=0)
    bench_reconstruct(plan, tmp_path, picture=False)
    with pytest.raises(InputError, match=r"smoke.config\.yaml: hand_model: expected None, found"):
        text = (tmp_path / "clip" / "smoke" / CONFIG).read_text().replace("hand_model: null", "hand_model: x")
        (tmp_path / "clip" / "smoke" / CONFIG).write_text(text)
        bench_reconstruct(plan, tmp_path, picture=False)

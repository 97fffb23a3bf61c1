"""`bigs bench engine` as it is called: a small run in processes of its own, and what it refuses."""

from __future__ import annotations

import builtins
import importlib
import json
import os
import subprocess
import sys
import typing
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import Answer, assert_refused

from bigs import _raster
from bigs.bench import worker
from bigs.bench.calls import Call, Task, centre_mask
from bigs.bench.curve import SETTINGS, every_pair
from bigs.bench.engine import variants
from bigs.bench.errors import relative_errors
from bigs.bench.machine import free_memory, peak_of
from bigs.bench.peers import PEERS
from bigs.bench.plan import PARTS, Plan
from bigs.bench.skips import SKIPS
from bigs.bench.workloads import KINDS, WorkloadSpec
from bigs.cli import bench as cli
from bigs.raster import RasterSettings

TINY = WorkloadSpec("A", scale=0.005)


@pytest.fixture(autouse=True)
def own_workloads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("BIGS_BENCH", raising=False)


def test_the_command_line_knows_every_name() -> None:
    assert typing.get_args(cli.Workload) == tuple(KINDS)
    assert typing.get_args(cli.Part) == PARTS
    assert typing.get_args(cli.Peer) == tuple(PEERS)


def test_the_peak_is_positive_and_its_level_known() -> None:
    assert _raster.simd_level() in ("avx512", "avx2", "neon", "baseline")
    assert 0.5 < _raster.fma_peak_gflops() < 2000


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--peers splat9000", ["splat9000", "--peers", "gsplat"]),
        ("--parts turbo", ["turbo", "--parts", "curve"]),
        ("--workloads E", ["E", "--workloads", "A"]),
        ("--repeats 0", ["--repeats", "expected at least 1", "found 0"]),
        ("--threads 0", ["--threads", "expected", "found [0]"]),
        ("--scale -1", ["--scale", "expected", "found -1"]),
        ("--budget 0", ["--budget", "expected", "found 0"]),
        ("--seed x", ["--seed"]),
    ],
)
def test_options_that_cannot_be(
    call: Callable[..., Answer], tmp_path: Path, options: str, words: list[str]
) -> None:
    answer = call("bench", "engine", "--out", tmp_path / "out", *options.split())
    assert_refused(answer)
    assert all(word in answer.err for word in words), answer.err
    assert list(tmp_path.iterdir()) == []


def test_a_scale_does_not_go_with_fixed_workloads(
    call: Callable[..., Answer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "workloads.py").write_text("")
    monkeypatch.setenv("BIGS_BENCH", str(tmp_path))
    assert_refused(call("bench", "engine", "--scale", "0.1"), "--scale", "BIGS_BENCH", "found 0.1")


def test_without_matplotlib_the_extra_is_named(
    call: Callable[..., Answer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = importlib.import_module

    def without(name: str, *arguments: str) -> object:
        if name.startswith("matplotlib"):
            raise builtins.ImportError(name)
        return real(name, *arguments)

    monkeypatch.setattr("bigs.bench.chart.importlib.import_module", without)
    answer = call("bench", "engine", "--out", tmp_path / "out", "--scale", "0.01")
    assert_refused(answer, "--parts curve", "matplotlib", "pip install 'bigs[bench]'")
    assert not (tmp_path / "out").exists()


def test_every_part_is_timed_beside_the_plain_case() -> None:
    plan = Plan((TINY,), threads=(2,))
    found = variants(plan, TINY, peers=["gsplat"])
    assert {v.lane.threads for v in found if v.part == "times"} == {1, 2}
    assert len({v for v in found}) == len(found)
    plain = Task(TINY)
    assert [v.task for v in found].count(plain) == 2 + sum(v.part == "levels" for v in found)
    assert len([v for v in found if v.part == "curve"]) == len(SETTINGS) - sum(
        p.task(plain) == plain for p in SETTINGS
    )
    assert {v.part for v in variants(Plan((TINY,), parts=()), TINY, [])} == {"times"}


@pytest.mark.parametrize("skip", SKIPS, ids=lambda skip: skip.label)
def test_what_is_left_out_leaves_the_image_alone(skip) -> None:
    """Where both sides show a pixel they show the same, but for what lies behind a stop."""
    base = Task(WorkloadSpec("D", scale=0.02))
    images = [Call(make(base)).forward().detach() for make in (skip.with_it, skip.without_it)]
    height, width = images[0].shape[-3:-1]
    inside = centre_mask(width, height)
    assert float((images[0] - images[1])[..., inside, :].abs().max()) < 1e-3


def test_unseen_gaussians_are_unseen() -> None:
    base = Task(WorkloadSpec("B", scale=0.01))
    (skip,) = [skip for skip in SKIPS if skip.work == 2]
    plain, more = (worker.counters(task) for task in (base, skip.with_it(base)))
    assert more["n_visible"] == plain["n_visible"] > 0
    assert len(Call(skip.with_it(base)).leaves["means"]) == 2 * len(Call(base).leaves["means"])


def test_the_error_is_zero_where_nothing_is_traded() -> None:
    base = Task(TINY)
    exact = Task(TINY, dtype="float64")
    by_rule, without = worker.errors(exact, exact, every_pair(base))
    assert by_rule["image"] == 0.0
    assert without["image"] > 1e-4
    loose = Task(TINY, settings=RasterSettings(alpha_threshold=0.1))
    assert worker.errors(loose, exact)[0]["means"] > 1e-2


def test_memory_of_some_work() -> None:
    assert peak_of(lambda: bytearray(os.urandom(1)) * 50_000_000) > 40e6
    free = free_memory()
    assert free is None or free > 2**20


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc/self/status")
def test_the_largest_so_far_is_not_that_of_the_process_that_started_this_one() -> None:
    """Linux keeps `ru_maxrss` over exec: `bigs prior fit` called from a notebook told the notebook's size."""
    large = bytearray(os.urandom(1)) * 300_000_000
    ask = "from bigs.bench.machine import largest_so_far; print(largest_so_far())"
    told = float(subprocess.run([sys.executable, "-c", ask], capture_output=True, check=True).stdout)
    assert 5e6 < told < 0.5 * len(large)


def test_an_environment_holds_in_its_worker_only() -> None:
    process = worker.Worker({"BIGS_RASTER_SIMD": "baseline", "RAYON_NUM_THREADS": "1"})
    try:
        assert process.run(_raster.simd_level) == "baseline"
        assert "BIGS_RASTER_SIMD" not in os.environ
        sample = process.run(worker.sample, Task(TINY))
        assert min(sample) > 0
        assert sample.wall == sample.forward_wall + sample.backward_wall
        with pytest.raises(KeyError):
            process.run(worker.sample, Task(TINY, renderer="nobody"))
    finally:
        process.close()


@pytest.mark.slow
def test_a_small_run_writes_what_it_prints(call: Callable[..., Answer], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "out"
    options = "--scale 0.005 --workloads A D --threads 1 --repeats 1 --parts stages skips curve"
    answer = call("bench", "engine", "--out", out, *options.split())
    assert answer.code == 0, answer.err
    titles = ["Times", "Stages, and what torch adds", "Errors", "Work left out", "Time against error"]
    page = (out / "engine.md").read_text()
    assert [line[3:] for line in page.splitlines() if line.startswith("## ")] == titles
    assert [line for line in answer.out.splitlines() if line in titles] == titles
    numbers = json.loads((out / "engine.json").read_text())
    assert list(numbers["workloads"]) == ["A", "D"]
    for workload in numbers["workloads"].values():
        assert workload["pairs"] > 0
        assert all(row["cpu"] > 0 and row["runs"] == 1 for row in workload["times"])
        assert workload["errors"]["float32 against float64"]["image"] < 1e-5
        assert len(workload["curve"]) == len(SETTINGS)
        assert len(workload["skips"]) == len(SKIPS)
    assert (out / "engine.png").stat().st_size > 5_000


def test_the_worst_are_left_out_of_an_error_and_no_others() -> None:
    truth = {"means": np.ones((4, 3)), "opacities": np.full(4, 2.0)}
    found = {name: array.copy() for name, array in truth.items()}
    found["means"][2] += 5.0
    found["opacities"][1:3] += [3.0, 1.0]
    assert relative_errors(truth, found)["means"] == pytest.approx(5.0 / 2)
    without = relative_errors(truth, found, leave_out=1)
    assert without == pytest.approx({"means": 0.0, "opacities": 1 / 4})

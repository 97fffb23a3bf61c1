"""The command line: help, arguments and settings. A refusal is one sentence and leaves nothing behind."""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from command_line import Answer, assert_refused, run_bigs
from fake_runs import idle_switch

import bigs
from bigs.checks import InputError
from bigs.cli.__main__ import run
from bigs.commands.run.reconstruct import Outcome
from bigs.train.fit_report import FitReport
from bigs.train.plan.config import RunConfig
from bigs.train.plan.presets import PRESETS


@pytest.mark.parametrize(
    "command",
    [
        "",
        "demo",
        "doctor",
        "info",
        "preprocess",
        *(f"preprocess {step}" for step in ("all", "frames", "masks", "hands", "object", "align", "build")),
        "reconstruct",
        "eval",
        "render",
        "export",
        "view",
        "batch",
        "ablate",
        "prior",
        "prior fit",
        "prior train",
        "bench",
        "bench adjustment",
        "bench engine",
        "bench motion",
        "bench preprocess",
        "bench reconstruct",
        "bench robustness",
    ],
)
def test_help(call: Callable[..., Answer], command: str) -> None:
    answer = call(*command.split(), "--help")
    assert answer.code == 0
    assert answer.err == ""
    assert "usage: bigs" in answer.out
    text = " ".join(answer.out.replace("│", " ").split())
    expected = {
        "demo": "Make a little clip of two hands",
        "preprocess": "from a video or images",
        "preprocess all": "21 keypoints of each hand",
        "preprocess frames": "Keep every Nth frame",
        "preprocess masks": "label images of right hand",
        "preprocess hands": "Output of a hand estimator",
        "preprocess object": "structure from motion",
        "preprocess align": "one metric space",
        "preprocess build": "that HOLD and bigs reconstruct",
        "reconstruct": "change one setting, as path=value",
        "render": "transforms.json",
        "export": "hand-meshes",
        "eval": "gt.npz",
        "batch": "finished ones are kept",
        "doctor": "what that would enable",
        "view": "can be reached from this machine only",
        "info": "HANDS-challenge build folder",
        "prior": "sides of an object that a clip never shows",
        "prior fit": "textual inversion",
        "prior train": "folder of meshes",
        "bench": "Measure speed",
        "ablate": "beside the paper's Table 3",
        "bench adjustment": "consecutive frames that see a point",
        "bench engine": "rounds of everything",
        "bench motion": "from their own poses",
        "bench preprocess": "simulated keypoints",
        "bench reconstruct": "how the cost grows",
        "bench robustness": "worse masks, pictures, poses",
    }
    for word in [expected[command]] if command else [name for name in expected if " " not in name]:
        assert word in text


def test_a_reader_that_has_enough_is_no_failure_to_tell() -> None:
    """As in `bigs --help | head -1`."""
    command = [sys.executable, "-m", "bigs.cli", "reconstruct", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""


def test_version(call: Callable[..., Answer]) -> None:
    assert call("--version") == (0, f"bigs {bigs.__version__}\n", "")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("reconstruct CLIP --out OUT --bogus 3", ["--bogus"]),
        ("reconstruct CLIP --out OUT --preset turbo", ["turbo", "--preset", "smoke"]),
        ("reconstruct CLIP", ["--out"]),
        ("reconstruct CLIP --out OUT --preset fast --config plan.yaml", ["--preset fast", "plan.yaml"]),
        ("ablate CLIP --out OUT --preset fast --config plan.yaml", ["--preset fast", "plan.yaml"]),
        ("reconstruct CLIP --out OUT --without turbo", ["--without", "share", "contact", "ssim", "'turbo'"]),
        ("reconstruct CLIP --out OUT --threads two", ["--threads"]),
        ("reconstruct CLIP --out OUT --threads -1", ["--threads", "expected 0", "found -1"]),
        ("frobnicate", ["frobnicate"]),
        ("bench", ["engine"]),
        ("bench frobnicate", ["frobnicate", "engine"]),
        ("", ["demo"]),
        ("export RUN --format fbx", ["fbx", "--format", "ply"]),
    ],
)
def test_arguments_that_are_none(
    call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path, arguments: str, words: list[str]
) -> None:
    places = {"CLIP": tiny_clip, "OUT": tmp_path / "out", "RUN": tmp_path}
    answer = call(*(places.get(argument, argument) for argument in arguments.split()))
    assert_refused(answer)
    assert all(word in answer.err for word in words)
    assert list(tmp_path.iterdir()) == []


def test_ingredients_are_left_out(
    call: Callable[..., Answer], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given: list[RunConfig] = []

    def run(clip: Path, out: Path, config: RunConfig, **_: Any) -> Outcome:
        given.append(config)
        return Outcome(out, [("score", "unit", "result")], FitReport(), 0.0)

    monkeypatch.setattr("bigs.commands.run.reconstruct.reconstruct", run)
    idle = idle_switch(PRESETS["fast"])
    options = ["--preset", "fast", "--set", "seed=3", "--without", "share", "--without", idle]
    answer = call("reconstruct", tmp_path, "--out", tmp_path / "out", *options)
    assert answer.code == 0, answer.err
    fast = replace(PRESETS["fast"], seed=3)
    assert given == [replace(fast, hand=replace(fast.hand, shared=False))]
    assert f"--without {idle}: this plan does not contain it" in answer.out
    assert "--without share" not in answer.out


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("seed", ["--set seed", "expected path=value"]),
        ("raster.eps2=1", ["--set raster.eps2=1", "did you mean eps2d?"]),
        ("raster.eps2d=wide", ["--set raster.eps2d", "expected float", "'wide'"]),
        ("raster.eps2d=[", ["--set raster.eps2d=["]),
        ("raster.eps2d=-1", ["eps2d", "expected", "found -1"]),
        ("raster.tile_size=12", ["tile_size", "expected 4, 8, 16 or 32", "found 12"]),
        ("raster.exp_degree=6", ["exp_degree", "expected 3, 4 or 5", "found 6"]),
        ("stages.joint.weights.typo=1", ["joint", "expected one of", "found 'typo'"]),
        (
            "stages.joint.lrs.hand.typo=1",
            ["expected one of", "groups", "found 'hand.typo'"],
        ),
        ("stages.joint.image_size=-2", ["image_size", "expected", "found -2"]),
        ("stages.object-scale-search.candidates=0", ["candidates", "expected", "found 0"]),
        ("initial.surface_resolution=0", ["surface_resolution", "expected", "found 0"]),
        ("initial.surface_kept=0", ["surface_kept", "expected 0.01 to", "found 0"]),
        ("object.n_gaussians=0", ["n_gaussians", "expected", "found 0"]),
        ("checkpoint_every=0", ["checkpoint_every", "expected", "found 0"]),
    ],
)
def test_settings_that_cannot_be(
    call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path, change: str, words: list[str]
) -> None:
    """All is checked before anything is written, however late in the plan it would matter."""
    out = tmp_path / "out"
    earlier = ("hands-coarse", "hands-fine", "appearance", "contact")
    quick = [f"--set=stages.{stage}.steps=1" for stage in earlier]
    answer = call("reconstruct", tiny_clip, "--out", out, "--preset", "smoke", *quick, "--set", change)
    assert_refused(answer, *words)
    assert not out.exists()


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (FloatingPointError("stage joint, step 3: image is not finite"), 3, ["joint", "checkpoint is kept"]),
        (KeyboardInterrupt(), 130, ["interrupted", "--resume"]),
        (InputError("x: expected [bold]1[/bold], found 2"), 2, ["x: expected [bold]1[/bold], found 2"]),
        (OSError(28, "No space left", "run/x.ply"), 4, ["x.ply", "expected", "found: No space left"]),
    ],
)
def test_other_ends_are_one_line_too(
    call: Callable[..., Answer],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    error: BaseException,
    code: int | None,
    words: list[str],
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr("bigs.commands.folder.contents.load_run", fail)
    answer = call("export", tmp_path, "--format", "ply")
    assert_refused(answer, *words)
    assert code is None or answer.code == code


@pytest.mark.slow
def test_a_refusal_in_a_process_of_its_own(tmp_path: Path) -> None:
    """As a shell sees it: the code, and one line without colour."""
    answer = run_bigs("reconstruct", tmp_path / "nowhere", "--out", tmp_path / "out")
    assert_refused(answer, "bigs: ", "nowhere: expected a clip folder")
    assert "\x1b" not in answer.err


@pytest.mark.parametrize(("given", "threads"), [(None, "1"), ("3", "3")])
def test_numpy_multiplies_on_one_thread_unless_told_otherwise(
    monkeypatch: pytest.MonkeyPatch, given: str | None, threads: str
) -> None:
    """The setting counts when numpy is loaded, and results must not depend on the number of cores."""
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    if given is not None:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", given)
    script = """
import os, sys
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy":
            print(os.environ.get("OPENBLAS_NUM_THREADS"))
sys.meta_path.insert(0, Watch())
import bigs.cli
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [threads]


def test_help_and_refusals_do_not_wait_for_torch() -> None:
    script = "import sys, bigs.cli.app; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_modules_load_without_a_search_for_cycles() -> None:
    """In the block that loads torch, whatever becomes of it; a later block is an ordinary one."""
    script = """
import gc, sys, types
from bigs.cli.terminal import importing
try:
    with importing():
        print(gc.isenabled())
        sys.modules["torch"] = types.ModuleType("torch")
        raise ImportError
except ImportError:
    print(gc.isenabled(), gc.get_freeze_count() > 10_000)
with importing():
    print(gc.isenabled())
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["False", "True True", "True"]


@pytest.mark.parametrize("code", [0, 3])
def test_the_process_ends_without_a_search_for_cycles(monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    def leave() -> None:
        sys.exit(code)

    monkeypatch.setattr("bigs.cli.__main__.main", leave)
    before = gc.get_freeze_count()
    try:
        with pytest.raises(SystemExit) as left:
            run()
        assert left.value.code == code
        assert gc.get_freeze_count() > before + 1000
    finally:
        gc.unfreeze()

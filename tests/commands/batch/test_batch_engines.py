"""Real workers on real clips, one of them killed: nothing is lost, nothing is done twice."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import fake_slurm
import pytest
import yaml
from command_line import Answer
from family import Family
from forked import Nursery

from bigs.data.synthetic import make_clip
from bigs.hand import HandModel
from bigs.types import Side

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")]

STAGES = ("hands-coarse", "hands-fine", "grasped", "appearance", "contact", "regrasp", "joint", "detail")
QUICK = [f"stages.{stage}.{change}" for stage in STAGES for change in ("steps=4", "image_size=40")]
CHANGES = [*QUICK, "stages.object-scale-search.candidates=3", "checkpoint_every=1"]
# The results that two undisturbed runs share byte by byte.
RESULTS = ("scene.safetensors", "poses.npz", "gaussians/object.ply")


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory, both_hands: dict[Side, HandModel]) -> Path:
    folder = tmp_path_factory.mktemp("batch") / "clip"
    make_clip(folder, hand_models=both_hands, frames=5, width=80, height=60, seed=1)
    # Unscored: that takes longer than these few steps.
    (folder / "gt.npz").unlink()
    return folder


@pytest.fixture(scope="module")
def undisturbed(clip: Path, nursery: Nursery) -> dict[str, bytes]:
    """Results of the clip reconstructed outside any batch."""
    out, said = clip.parent / "undisturbed", clip.parent / "said"
    settings = [f"--set={change}" for change in CHANGES]
    nursery.start("reconstruct", clip, "--preset", "smoke", *settings, "--out", out, output=said)
    assert nursery.ended() == 0, said.read_text()
    return {name: (out / name).read_bytes() for name in RESULTS}


def manifest(folder: Path, clip: Path, names: list[str]) -> Path:
    """The clip under several names, and one that is not there."""
    entries = [{"clip": str(clip), "name": name} for name in names]
    document = {
        "defaults": {"preset": "smoke", "set": CHANGES},
        "clips": [*entries, {"clip": "gone", "name": "gone"}],
    }
    (folder / "manifest.yaml").write_text(yaml.safe_dump(document))
    return folder / "manifest.yaml"


# A process that imports this kills itself, once among all, when it has written a run's first checkpoint.
KILLS_ITSELF = """
import os, pathlib, signal
rename = os.replace
def replace(source, target, **options):
    rename(source, target, **options)
    path = pathlib.Path(target)
    if path.name == "latest.safetensors":
        try:
            with open(os.environ["BIGS_TEST_VICTIM"], "x") as file:
                parent = pathlib.Path(f"/proc/{os.getppid()}/cmdline")
                file.write(path.parents[1].name + "\\n" + (parent.read_text() if parent.exists() else ""))
        except FileExistsError:
            return
        os.kill(os.getpid(), signal.SIGKILL)
os.replace = replace
"""


@pytest.fixture
def batch(family: Family, tmp_path: Path) -> Callable[..., subprocess.Popen[bytes]]:
    """Starts `bigs batch`; its words go to tmp_path / "said"."""

    def start(*arguments: str | Path, **variables: str) -> subprocess.Popen[bytes]:
        with (tmp_path / "said").open("wb") as file:
            env = {"OMP_NUM_THREADS": "1", **variables}
            return family.start_bigs("batch", *arguments, env=env, stdout=file, stderr=file)

    return start


def statuses(out: Path) -> dict[str, dict]:
    return {path.parent.name: json.loads(path.read_text()) for path in out.glob("*/status.json")}


@pytest.mark.parametrize("engine", ["ray", "processes"])
def test_a_worker_is_killed_mid_clip(
    batch: Callable[..., subprocess.Popen[bytes]],
    call: Callable[..., Answer],
    clip: Path,
    undisturbed: dict[str, bytes],
    tmp_path: Path,
    engine: str,
) -> None:
    if engine == "ray":
        pytest.importorskip("ray", reason="needs the extra 'ray'")
    out, said = tmp_path / "out", tmp_path / "said"
    options = ["--out", out, "--engine", engine, "--workers", "2", "--threads", "1"]
    path = manifest(tmp_path, clip, ["a"])
    (tmp_path / "first").mkdir()
    (tmp_path / "first" / "sitecustomize.py").write_text(KILLS_ITSELF)
    first = {"PYTHONPATH": str(tmp_path / "first"), "BIGS_TEST_VICTIM": str(tmp_path / "victim")}
    # The clip that is not there is told by the exit code, and by its row.
    process = batch(path, *options, **first)
    assert process.wait() == 5, said.read_text()
    name, _, parent = (tmp_path / "victim").read_text().partition("\n")
    assert name == "a"
    if engine == "processes" and sys.platform == "linux":
        # Forked by a server that has imported what a job needs.
        assert "forkserver" in parent and "bigs.commands.batch.job" in parent

    found = statuses(out)
    assert {name: (status["state"], status["attempts"]) for name, status in found.items()} == {
        "a": ("finished", 2),
        "gone": ("failed", 1),
    }
    assert process.pid not in {status["pid"] for status in found.values()}
    log = (out / "a" / "batch.log").read_text()
    assert (log.count("attempt "), log.count("finished")) == (2, 1)
    # The killed one went on from its checkpoint and came to the same end.
    assert [name for name in RESULTS if (out / "a" / name).read_bytes() != undisturbed[name]] == []
    steps = [json.loads(line) for line in (out / "a" / "log.jsonl").read_text().splitlines()]
    places = [(event["index"], event["step"]) for event in steps if event["event"] == "step"]
    assert places == sorted(set(places))
    assert "gone: expected a clip" in (out / "summary.md").read_text()

    if engine == "ray":
        return
    # Called again, nothing is done twice: only the missing clip is tried.
    before = (out / "a" / "scene.safetensors").stat().st_mtime_ns
    again = call("batch", path, "--out", out, "--threads", "1")
    assert again.code == 5
    assert "clips were finished before; 1 attempts" in again.out + again.err
    assert (out / "a" / "scene.safetensors").stat().st_mtime_ns == before


def test_submitit_in_processes_of_its_own(
    batch: Callable[..., subprocess.Popen[bytes]], clip: Path, tmp_path: Path
) -> None:
    """Without a cluster, to try it out; that the jobs do what they should is shown with Slurm's programs."""
    pytest.importorskip("submitit", reason="needs the extra 'slurm'")
    out, said = tmp_path / "out", tmp_path / "said"
    options = [
        "--engine",
        "slurm",
        "--slurm-cluster",
        "local",
        "--threads",
        "1",
        "--slurm",
        "timeout_min=600",
    ]
    process = batch(manifest(tmp_path, clip, []), "--out", out, *options)
    assert process.wait() == 5, said.read_text()
    found = statuses(out)["gone"]
    assert found["state"] == "failed" and found["pid"] not in (0, process.pid)


def test_jobs_of_a_slurm_cluster(
    batch: Callable[..., subprocess.Popen[bytes]],
    clip: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As submitit speaks to Slurm; the programs that answer are stand-ins."""
    pytest.importorskip("submitit", reason="needs the extra 'slurm'")
    slurm, out, said = tmp_path / "slurm", tmp_path / "out", tmp_path / "said"
    for name, value in fake_slurm.install(slurm).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("PATH", f"{slurm}{os.pathsep}{os.environ['PATH']}")
    options = ["--engine", "slurm", "--threads", "1", "--slurm", "slurm_partition=cpu"]
    assert batch(manifest(tmp_path, clip, ["a"]), "--out", out, *options).wait() == 5, said.read_text()
    found = statuses(out)
    assert (found["a"]["state"], found["gone"]["state"]) == ("finished", "failed"), said.read_text()
    assert found["a"]["pid"] != found["gone"]["pid"]
    assert (out / "a" / "report.html").is_file()
    assert len((slurm / "submitted").read_text().splitlines()) == 2
    for script in slurm.glob("*.sh"):
        lines = script.read_text().splitlines()
        assert {"#SBATCH --cpus-per-task=1", "#SBATCH --partition=cpu", "#SBATCH --job-name=bigs"} <= {*lines}

"""The four kinds of scene: repeatable, of the sizes they say, and the count of their pairs."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bigs.bench.errors import relative_errors
from bigs.bench.pairs import count_pairs
from bigs.bench.workloads import KINDS, PARAMETERS, WorkloadSpec, from_environment, make_workload
from bigs.checks import InputError
from bigs.raster import RasterSettings, rasterization

NAMES = tuple(KINDS)


@pytest.mark.parametrize("name", NAMES)
def test_the_same_spec_is_the_same_scene(name: str) -> None:
    first, second = (make_workload(WorkloadSpec(name, seed=3, scale=0.01)) for _ in range(2))
    other = make_workload(WorkloadSpec(name, seed=4, scale=0.01))
    for parameter in PARAMETERS:
        assert np.array_equal(first.gaussians[parameter], second.gaussians[parameter])
        assert first.gaussians[parameter].dtype == np.float32
    assert np.array_equal(first.weights, second.weights)
    assert not np.array_equal(first.gaussians["means"], other.gaussians["means"])


@pytest.mark.parametrize("name", NAMES)
def test_sizes_follow_the_scale(name: str) -> None:
    kind = KINDS[name]
    whole, quarter = (make_workload(WorkloadSpec(name, scale=scale)) for scale in (1.0, 0.25))
    assert len(whole.gaussians["means"]) == kind.gaussians
    assert (whole.width, whole.height) == (kind.size, kind.size)
    assert len(quarter.gaussians["means"]) == kind.gaussians // 4
    assert quarter.width == kind.size // 2
    assert quarter.weights.shape == (quarter.height, quarter.width, 3)


@pytest.mark.parametrize("name", NAMES)
def test_every_kind_can_be_seen(name: str) -> None:
    workload = make_workload(WorkloadSpec(name, scale=0.02))
    tensors = [torch.from_numpy(workload.gaussians[parameter]) for parameter in PARAMETERS]
    view, K = torch.from_numpy(workload.viewmat)[None], torch.from_numpy(workload.K)[None]
    output = rasterization(*tensors, view, K, workload.width, workload.height)
    assert float(output.alphas.mean()) > 0.1
    assert (output.info["radii"].amax(-1) > 0).float().mean() > 0.5


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(InputError, match="workload: expected one of A, B, C, D, found 'E'"):
        make_workload(WorkloadSpec("E"))


def test_a_folder_without_workloads_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setenv("BIGS_BENCH", str(tmp_path))
    with pytest.raises(InputError, match=r"BIGS_BENCH: expected a folder with workloads\.py"):
        from_environment()


def test_a_folder_takes_the_place_of_the_generators(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    (tmp_path / "workloads.py").write_text(
        "import numpy as np\n"
        "def make_workload(name):\n"
        "    one = np.ones((1, 3), np.float32)\n"
        "    return dict(means=2 * one, quats=np.ones((1, 4), np.float32), scales=one, opacities=one[:, 0],\n"
        "                colors=one, viewmat=np.eye(4, dtype=np.float32), K=np.eye(3, dtype=np.float32),\n"
        "                width=5, height=7, weights=np.ones((7, 5, 3), np.float32))\n"
    )
    monkeypatch.setenv("BIGS_BENCH", str(tmp_path))
    workload = make_workload(WorkloadSpec("A", folder=from_environment()))
    assert (workload.width, workload.height) == (5, 7)
    assert np.array_equal(workload.gaussians["means"], [[2, 2, 2]])


@pytest.mark.parametrize("name", NAMES)
def test_pairs_are_those_that_change_the_image(name: str) -> None:
    """With alpha held at the threshold and no stop each pair dims its pixel by one factor: counted twice."""
    workload = make_workload(WorkloadSpec(name, scale=0.005))
    settings = RasterSettings(max_alpha=1 / 255, min_transmittance=0.0)
    tensors = [torch.from_numpy(workload.gaussians[parameter]).double() for parameter in PARAMETERS]
    view, K = torch.from_numpy(workload.viewmat)[None].double(), torch.from_numpy(workload.K)[None].double()
    alphas = rasterization(*tensors, view, K, workload.width, workload.height, settings=settings).alphas
    # Alpha of 1/255 exactly is a pair, so the factor is 254/255 for each.
    dimmings = torch.log1p(-alphas) / np.log(254 / 255)
    assert count_pairs(workload, settings) == int(dimmings.round().sum())
    assert count_pairs(workload, RasterSettings()) <= int(dimmings.round().sum())


def test_errors_are_relative_and_say_what_has_none() -> None:
    truth = {"image": np.array([3.0, 4.0]), "means": np.zeros(2), "scales": np.ones(2)}
    found = {"image": np.array([3.0, 4.5]), "means": np.zeros(2), "scales": np.array([1.0, np.nan])}
    errors = relative_errors(truth, found)
    assert errors["image"] == pytest.approx(0.1)
    assert np.isnan(errors["means"])
    assert errors["scales"] == np.inf
    assert "colors" not in errors

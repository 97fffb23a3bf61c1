"""Workloads A and D of the benchmark against their float64 reference, which shares no code with bigs."""

import importlib.util
import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from bigs.raster import rasterization

pytestmark = pytest.mark.skipif("BIGS_BENCH" not in os.environ, reason="BIGS_BENCH names no benchmark folder")


@cache
def workloads():
    path = Path(os.environ["BIGS_BENCH"]) / "workloads.py"
    spec = importlib.util.spec_from_file_location("bench_workloads", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def workload_and_reference(name):
    workload = workloads().make_workload(name)
    return workload, workloads().render_reference(workload)


def render(workload, dtype):
    names = workloads().PARAMS
    leaves = {name: torch.tensor(workload[name], dtype=dtype, requires_grad=True) for name in names}
    view, K, background, weights = (
        torch.tensor(workload[name], dtype=dtype)[None] for name in ("viewmat", "K", "background", "weights")
    )
    colors, _, _ = rasterization(
        *leaves.values(), view, K, workload["width"], workload["height"], backgrounds=background
    )
    v = torch.autograd.grad(colors, list(leaves.values()), weights)
    gradients = {f"g_{name}": grad.numpy() for name, grad in zip(names, v, strict=True)}
    return {"image": colors[0].detach().numpy(), **gradients}


@pytest.mark.parametrize("name", ["A", "D"])
@pytest.mark.parametrize(
    ("dtype", "image_tolerance", "gradient_tolerance"),
    [(torch.float32, 1e-5, 1e-4), (torch.float64, 1e-9, 1e-9)],
)
def test_error(name, dtype, image_tolerance, gradient_tolerance):
    workload, reference = workload_and_reference(name)
    errors = workloads().errors(reference, render(workload, dtype))
    assert len(errors) == 6
    for key, (_, relative) in errors.items():
        # In A rotations have no gradient: nan stands for 0 / 0.
        assert np.isnan(relative) or relative <= (
            image_tolerance if key == "image" else gradient_tolerance
        ), key

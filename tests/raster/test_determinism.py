"""The same bits for any number of threads and every run."""

import os
import subprocess
import sys

import pytest
import torch
from raster_scenes import gradients, scene

# Imports once, and then works in a process for each number of threads, which read it when they first need it.
SCRIPT = """
import hashlib, os, sys
sys.path.insert(0, sys.argv[1])
import torch
from bigs.raster import rasterization
from raster_scenes import gradients, scene
for threads in sys.argv[2:]:
    child = os.fork()
    if child == 0:
        os.environ["RAYON_NUM_THREADS"] = threads
        break
    if os.waitpid(child, 0)[1] != 0:
        sys.exit(f"{threads} threads: failed")
else:
    sys.exit()
digest = hashlib.sha256()
# Few and many channels, shared and own inputs, several entries and cameras, with and without a mask.
for channels, batch, cameras, mode, dtype in (
    (4, (5,), 2, "RGB+D", torch.float32),
    (11, (), 1, "RGB+ED", torch.float32),
    (3, (2,), 3, "RGB", torch.float64),
):
    inputs = scene(1500, channels, cameras, batch, width=100, height=70, dtype=dtype)
    if batch:
        for name in ("scales", "opacities", "colors", "backgrounds"):
            inputs[name] = inputs[name][0]
    mask = torch.rand(*batch, cameras, 70, 100, generator=torch.Generator().manual_seed(1)) < 0.7
    for options in ({}, {"pixel_mask": mask}):
        colors, alphas, grads = gradients({**inputs, **options}, render_mode=mode)
        for tensor in (colors, alphas, *grads.values()):
            digest.update(tensor.numpy().tobytes())
coeffs = torch.rand(1500, 16, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
inputs = scene(1500, cameras=3, width=100, height=70, dtype=torch.float32)
inputs["means"].requires_grad_()
inputs["colors"] = coeffs
wanted = dict(sh_degree=3, means2d="full", absgrad=True, median_depth=True, camera_model="ortho")
colors, _, info = rasterization(**inputs, **wanted)
colors.square().sum().backward()
centres = info["means2d"]
for tensor in (colors, coeffs.grad, inputs["means"].grad, centres, centres.absgrad, info["median_ids"]):
    digest.update(tensor.detach().numpy().tobytes())
print(digest.hexdigest(), flush=True)
os._exit(0)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
def test_thread_counts():
    command = [sys.executable, "-c", SCRIPT, os.path.dirname(__file__), "1", "2", "3", "8"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    single, *more = done.stdout.split()
    assert len(single) == 64
    assert more == [single] * 3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_repeated_runs(dtype):
    inputs = scene(n=500, batch=(3,), width=70, height=50, dtype=dtype)
    first, second = gradients(inputs), gradients(inputs)
    assert torch.equal(first[0], second[0]) and torch.equal(first[1], second[1])
    assert all(torch.equal(first[2][name], second[2][name]) for name in first[2])


def test_a_batch_is_its_entries():
    inputs = scene(n=400, batch=(4,), width=50, height=40, dtype=torch.float32)
    whole = gradients(inputs)[0]
    for i in range(4):
        entry = {k: v[i] if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}
        assert torch.equal(gradients(entry)[0], whole[i])

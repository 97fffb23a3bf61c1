"""The adapters of other renderers; what runs them is tested where they are installed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from bigs.bench import peers
from bigs.bench.calls import Call, Task
from bigs.bench.errors import relative_errors
from bigs.bench.workloads import WorkloadSpec


def test_weights_are_alpha_times_what_is_left_on_each_ray() -> None:
    alphas = torch.tensor([0.5, 0.25, 0.1, 0.999, 0.3], requires_grad=True)
    rays = torch.tensor([0, 0, 3, 3, 3])
    weights, transmittances = peers._weights_of_alphas(alphas, ray_indices=rays, n_rays=5)
    assert transmittances.tolist() == pytest.approx([1, 0.5, 1, 0.9, 0.9 * 0.001], rel=1e-4)
    assert weights.tolist() == pytest.approx([0.5, 0.125, 0.1, 0.8991, 0.00027], rel=1e-4)
    (gradient,) = torch.autograd.grad(weights[1], alphas)
    assert gradient.tolist() == pytest.approx([-0.25, 0.5, 0, 0, 0])


def test_sums_along_rays() -> None:
    weights, rays = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0, 2, 2])
    values = torch.tensor([[1.0, 0.0], [1.0, 1.0], [2.0, 0.0]])
    summed = peers._accumulate_along_rays(weights, values, ray_indices=rays, n_rays=3)
    assert summed.tolist() == [[1, 0], [0, 0], [8, 2]]
    assert peers._accumulate_along_rays(weights, None, ray_indices=rays, n_rays=3).tolist() == [[1], [0], [5]]


def test_pairs_lie_pixel_by_pixel_front_to_back() -> None:
    """Two wide Gaussians over a 3x2 image of one tile: the list's order is that of each pixel."""
    means2d, conics = torch.tensor([[[1.5, 1.0], [1.5, 1.0]]]), torch.tensor([[[0.01, 0.0, 0.01]] * 2])
    opacities, ids = torch.tensor([[0.5, 0.6]]), torch.tensor([1, 0], dtype=torch.int32)
    found = peers._indices_in_range(
        0, 1, torch.ones(1, 2, 3), means2d, conics, opacities, 3, 2, 16, torch.zeros(1, 1, 1).int(), ids
    )
    assert found[0].tolist() == [1, 0] * 6
    assert found[1].tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    assert found[2].tolist() == [0] * 12


@pytest.mark.parametrize("name", peers.PEERS)
def test_a_peer_that_is_there_renders_what_bigs_does(name: str) -> None:
    if not peers.is_installed(name):
        pytest.skip(f"{name} is not installed: {peers.PEERS[name].install}")
    task = Task(WorkloadSpec("B", scale=0.005))
    ours, theirs = Call(task), Call(replace(task, renderer=name))
    results = []
    for call in (ours, theirs):
        image = call.forward()
        results.append({"image": image.detach().numpy(), **call.backward(image)})
    errors = relative_errors(*results)
    assert max(value for value in errors.values() if not np.isnan(value)) < 1e-3

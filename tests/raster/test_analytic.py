"""Scenes whose image can be worked out on paper, and scenes of a size that only a bound can be put on."""

import math
import resource
import time
from pathlib import Path

import pytest
import torch
from raster_scenes import relative, scene

from bigs.checks import InputError
from bigs.raster import RasterSettings, rasterization


def facing(n, width=9, height=9, dtype=torch.float32, **options):
    """n Gaussians on the axis of a camera at the origin, whose middle pixel looks along it."""
    inputs = scene(n=n, width=width, height=height, dtype=dtype, **options)
    inputs["viewmats"] = torch.eye(4, dtype=dtype)[None]
    inputs["Ks"][0, 0, 2], inputs["Ks"][0, 1, 2] = width / 2, height / 2
    inputs["means"] = torch.tensor([0.0, 0.0, 1.0], dtype=dtype).repeat(n, 1)
    del inputs["backgrounds"]
    return inputs


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_coincident_gaussians_are_a_power(dtype):
    # At the centre alpha is the opacity o: k of n Gaussians let (1 − o)^k through, whatever their sizes.
    n, o = 5000, 0.0078125
    inputs = facing(n, dtype=dtype)
    inputs["opacities"] = torch.full((n,), o, dtype=dtype, requires_grad=True)
    inputs["colors"] = torch.ones(n, 3, dtype=dtype)
    settings = RasterSettings(min_transmittance=1e-6)
    colors, alphas, _ = rasterization(**inputs, settings=settings)
    seen = math.ceil(math.log(1e-6) / math.log1p(-o)) - 1
    error = 2e-5 if dtype == torch.float32 else 1e-12
    assert abs(alphas[0, 4, 4, 0].item() - (1 - (1 - o) ** seen)) < error
    assert torch.equal(colors[0, 4, 4, :1], colors[0, 4, 4, 1:2])
    assert abs(colors[0, 4, 4, 0].item() - alphas[0, 4, 4, 0].item()) < error
    # d alpha / d o_i = (1 − o)^(k − 1) for those that are seen, exactly 0 for the rest.
    (v,) = torch.autograd.grad(alphas[0, 4, 4, 0], inputs["opacities"])
    assert relative(v[:seen], torch.full((seen,), (1 - o) ** (seen - 1), dtype=torch.float64)) < (
        1e-3 if dtype == torch.float32 else 1e-9
    )
    assert (v[seen:] == 0).all()


def test_one_gaussian_is_the_formula():
    inputs = facing(1, 33, 21, torch.float64)
    inputs["quats"][:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    inputs["scales"][0] = torch.tensor([0.2, 0.1, 0.3], dtype=torch.float64)
    settings = RasterSettings(alpha_threshold=0.0)
    _, alphas, _ = rasterization(**inputs, settings=settings)
    fx, fy = inputs["Ks"][0, 0, 0], inputs["Ks"][0, 1, 1]
    x = torch.arange(33).double() + 0.5 - 16.5
    y = torch.arange(21).double()[:, None] + 0.5 - 10.5
    q = x**2 / ((0.2 * fx) ** 2 + 0.3) + y**2 / ((0.1 * fy) ** 2 + 0.3)
    assert relative(alphas[0, ..., 0], inputs["opacities"] * torch.exp(-q / 2)) < 1e-12


def test_a_huge_gaussian_is_a_flat_colour():
    for scale in (1e4, 1e8, 1e15, 1e25):
        inputs = facing(1, 40, 30)
        inputs["scales"][:] = scale
        inputs["opacities"][:] = 0.625
        colors, alphas, _ = rasterization(**inputs)
        assert (alphas - 0.625).abs().max() < 1e-6
        assert (colors[0] - 0.625 * inputs["colors"][0]).abs().max() < 1e-6


def test_the_nearest_of_equals_is_the_first():
    # Opaque and in one place: almost all of the light is that of the first one.
    inputs = facing(600)
    inputs["opacities"][:] = 1.0
    inputs["scales"][:] = 0.5
    inputs["colors"] = torch.zeros(600, 1)
    for first in (0, 1, 299, 599):
        moved = {**inputs, "means": inputs["means"].clone(), "colors": inputs["colors"].clone()}
        moved["means"][:first, 2] = math.nextafter(1.0, 2.0) + 2.0**-23
        moved["colors"][first] = 1.0
        assert rasterization(**moved).colors[0, 4, 4, 0] > 0.998


def test_the_camera_must_stand_clear_of_the_near_plane():
    near = 0.01
    depths = torch.tensor([near, 0.0, -near, -1.0], dtype=torch.float32)
    inputs = facing(4)
    inputs["means"][:, 2] = depths
    assert (rasterization(**inputs).alphas == 0).all()
    assert rasterization(**inputs).info["n_visible"] == 0
    beyond = torch.nextafter(depths[:1], torch.ones(1))
    inputs["means"][0, 2] = beyond[0]
    colors, alphas, info = rasterization(**inputs)
    assert info["n_visible"] == 1 and alphas.max() > 0 and colors.isfinite().all()


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc to bound the memory")
def test_too_many_pairs_is_an_error_before_memory_runs_out():
    n, side = 90_000, 1000
    inputs = facing(n, side, side)
    inputs["scales"][:] = 100.0
    inputs["opacities"][:] = 0.9
    started = time.process_time()
    # Should it fill the memory after all, then with an error of its own and not the machine's.
    limits = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 3 * 2**30, limits[1]))
    try:
        with pytest.raises(InputError, match=r"2\^32"):
            rasterization(**inputs, settings=RasterSettings(tile_size=4))
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert time.process_time() - started < 10


@pytest.mark.slow
def test_many_pairs_are_no_error():
    # More than are listed at a go: 20,000 Gaussians in each of 4096 tiles.
    inputs = facing(20_000, 256, 256)
    inputs["scales"][:] = 100.0
    inputs["opacities"][:] = 0.625
    colors, alphas, info = rasterization(**inputs, settings=RasterSettings(tile_size=4))
    assert info["n_isects"] == 20_000 * 64 * 64
    assert (alphas > 0.999).all()
    assert torch.equal(colors, rasterization(**inputs).colors)


@pytest.mark.slow
def test_five_million():
    """All white over white is white; time and memory are of the order of the arrays."""
    n, side = 5_000_000, 128
    g = torch.Generator().manual_seed(0)
    means = torch.rand(n, 3, generator=g)
    means[:, :2] -= 0.5
    means[:, 2] = 1.0 + 0.5 * means[:, 2]
    leaves = [
        means,
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(n, 4).contiguous(),
        torch.full((n, 3), 1e-4),
        torch.full((n,), 0.03125),
        torch.ones(n, 1),
    ]
    for leaf in leaves:
        leaf.requires_grad_()
    K = torch.tensor([[[1.5 * side, 0, side / 2], [0, 1.5 * side, side / 2], [0, 0, 1]]])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    started = time.process_time()
    colors, alphas, info = rasterization(
        *leaves, torch.eye(4)[None], K, side, side, backgrounds=torch.ones(1, 1)
    )
    colors.sum().backward()
    seconds = time.process_time() - started
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 / n
    assert (colors - 1).abs().max() < 1e-5
    assert alphas.min() > 0.9 and info["n_visible"] > 0.5 * n
    # White on white: no gradient but that of the colours, which add up to the alphas.
    assert abs(leaves[4].grad.double().sum().item() / alphas.double().sum().item() - 1) < 1e-5
    assert seconds < 20 and grown < 400, f"{seconds:.1f} s, {grown:.0f} bytes per Gaussian"

"""Median depth: the Gaussian at which half the light is gone, and its gradient."""

import pytest
import torch
from raster_scenes import SMOOTH, relative, scene, without_perspective

from bigs.checks import InputError
from bigs.raster import RasterSettings, rasterization


def medians(inputs, backend, **options):
    leaves = {name: inputs[name].clone().requires_grad_() for name in ("means", "viewmats")}
    info = rasterization(**{**inputs, **leaves}, backend=backend, median_depth=True, **options).info
    depths = info["render_median"]
    v = torch.randn(depths.shape, generator=torch.Generator().manual_seed(1), dtype=depths.dtype)
    return info["median_ids"], depths, torch.autograd.grad(depths, list(leaves.values()), v)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"settings": RasterSettings(tile_size=4, antialiased=True)},
        {"settings": SMOOTH, "render_mode": "ED"},
        {"settings": RasterSettings(max_alpha=0.4)},
    ],
    ids=["default", "small tiles", "no cutoffs", "low limit"],
)
@pytest.mark.parametrize("ortho", [False, True])
def test_twin(options, ortho):
    inputs = scene(n=150, cameras=2, batch=(2,), width=45, height=38)
    inputs["means"] = inputs["means"][0]
    if ortho:
        inputs = without_perspective(inputs)
    ids, depths, gradients = medians(inputs, "rust", **options)
    slow_ids, slow_depths, slow_gradients = medians(inputs, "torch", **options)
    assert ids.shape == (2, 2, 38, 45) and depths.shape == (2, 2, 38, 45, 1)
    assert torch.equal(ids, slow_ids)
    assert relative(depths, slow_depths) < 1e-12
    for got, expected in zip(gradients, slow_gradients, strict=True):
        assert relative(got, expected) < 1e-12
    assert (ids >= 0).any()


def test_single_precision_names_almost_the_same():
    inputs = scene(n=400, width=60, height=50)
    exact = rasterization(**inputs, median_depth=True).info
    single = {k: v.float() if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}
    found = rasterization(**single, median_depth=True).info
    assert (found["median_ids"] != exact["median_ids"]).float().mean() < 1e-3


def test_layers():
    # Three walls before the camera: light 1, 0.6, 0.42 before each.
    inputs = scene(n=3, width=8, height=8)
    inputs["means"] = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 1.0], [0.0, 0.0, 2.0]]).double()
    inputs["scales"] = torch.full((3, 3), 1e3).double()
    inputs["opacities"] = torch.tensor([0.9, 0.4, 0.3]).double()
    ids = rasterization(**inputs, median_depth=True).info["median_ids"]
    assert (ids == 2).all()
    # A second wall that takes less leaves more than half for the third.
    inputs["opacities"][2] = 0.1
    assert (rasterization(**inputs, median_depth=True).info["median_ids"] == 0).all()
    # Where the light never falls to half, it is the last Gaussian seen.
    inputs["opacities"][0] = 0.01
    assert (rasterization(**inputs, median_depth=True).info["median_ids"] == 0).all()


def test_nothing_seen():
    inputs = scene(n=30, width=40, height=35)
    mask = torch.zeros(1, 35, 40, dtype=torch.bool)
    mask[:, 10:20, 10:20] = True
    info = rasterization(**inputs, pixel_mask=mask, median_depth=True).info
    slow = rasterization(**inputs, pixel_mask=mask, median_depth=True, backend="torch").info
    assert torch.equal(info["median_ids"], slow["median_ids"])
    assert (info["median_ids"][~mask] == -1).all() and (info["render_median"][~mask] == 0).all()
    assert "render_median" not in rasterization(**inputs).info
    with pytest.raises(InputError, match="median_depth: expected False for backend 'gsplat'"):
        rasterization(**inputs, median_depth=True, backend="gsplat")


def test_no_gaussians_have_no_median():
    inputs = scene(n=3)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        inputs[name] = inputs[name][..., :0] if name == "opacities" else inputs[name][..., :0, :]
    info = rasterization(**inputs, median_depth=True, means2d="packed").info
    assert (info["median_ids"] == -1).all() and (info["render_median"] == 0).all()

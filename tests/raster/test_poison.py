"""NaN and infinity: on the way in they are refused by name, on the way back they stay where they are."""

import pytest
import torch
from raster_scenes import DIFFERENTIABLE, scene

from bigs.checks import InputError
from bigs.raster import RasterSettings, rasterization

INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")
TILE = 16


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_input_is_named(name, value, dtype):
    inputs = scene(n=70, batch=(2,), cameras=2, dtype=dtype)
    at = (1,) + (0,) * (inputs[name].ndim - 2) + (inputs[name].shape[-1] - 1,)
    inputs[name][at] = value
    with pytest.raises(InputError) as error:
        rasterization(**inputs)
    assert str(error.value).startswith(f"{name}: expected finite values")
    assert str(list(at)) in str(error.value)


def poisoned(value, of_alpha):
    """Gradients of all inputs where one pixel's incoming gradient is `value`, and those where it is 0."""
    inputs = scene(n=400, width=64, height=48, dtype=torch.float32, seed=3)
    leaves = {k: inputs[k].clone().requires_grad_() for k in DIFFERENTIABLE}
    colors, alphas, _ = rasterization(**{**inputs, **leaves})
    results = []
    for here in (value, 0.0):
        v_colors, v_alphas = torch.ones_like(colors), torch.ones_like(alphas)
        (v_alphas if of_alpha else v_colors)[0, 20, 36, 0] = here
        # The whole tile is silent but for the pixel, so that what else the tile's Gaussians get is the same.
        found = torch.autograd.grad(
            [colors, alphas], list(leaves.values()), [v_colors, v_alphas], retain_graph=True
        )
        results.append(dict(zip(leaves, found, strict=True)))
    return inputs, *results


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("of_alpha", [False, True])
def test_a_poisoned_pixel_spoils_only_what_its_tile_shows(value, of_alpha):
    inputs, spoiled, clean = poisoned(value, of_alpha)
    info = rasterization(**inputs).info
    x, y = info["means2d"][0].unbind(-1)
    rx, ry = info["radii"][0].unbind(-1)
    left, top = 36 // TILE * TILE, 20 // TILE * TILE
    reaches = (x + rx >= left) & (x - rx <= left + TILE) & (y + ry >= top) & (y - ry <= top + TILE)
    assert 20 < (~reaches).sum() < 380
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert torch.equal(spoiled[name][~reaches], clean[name][~reaches])
        assert clean[name].isfinite().all()
    # It is noticed: nothing hides it from those who ask.
    assert not all(spoiled[name].isfinite().all() for name in spoiled)


def test_a_masked_pixel_is_not_even_poisonous():
    inputs = scene(n=200, width=40, height=30, dtype=torch.float32)
    mask = torch.rand(1, 30, 40, generator=torch.Generator().manual_seed(0)) < 0.5
    leaves = {k: inputs[k].clone().requires_grad_() for k in DIFFERENTIABLE}
    colors, alphas, _ = rasterization(**{**inputs, **leaves}, pixel_mask=mask)
    outputs = ([colors, alphas], list(leaves.values()))
    zero = torch.where(mask[..., None], torch.ones_like(colors), 0.0)
    nan = torch.where(mask[..., None], torch.ones_like(colors), float("nan"))
    clean = torch.autograd.grad(*outputs, [zero, zero[..., :1]], retain_graph=True)
    other = torch.autograd.grad(*outputs, [nan, nan[..., :1]])
    assert all(torch.equal(a, b) for a, b in zip(clean, other, strict=True))


def test_a_gradient_beyond_the_numbers_is_none():
    """A Gaussian a hair's breadth before the camera: its gradient overflows float32; nobody else's does."""
    inputs = scene(n=30, dtype=torch.float32)
    inputs["viewmats"] = torch.eye(4)[None]
    inputs["means"][7] = torch.tensor([5e-39, 0.0, 1e-37])
    inputs["scales"][7] = torch.tensor([1e-38, 2e-38, 1e-39])
    leaves = {k: inputs[k].clone().requires_grad_() for k in DIFFERENTIABLE}
    colors, _, info = rasterization(**{**inputs, **leaves}, settings=RasterSettings(near_plane=1e-38))
    assert info["depths"][0, 7] > 0
    found = torch.autograd.grad(colors.square().sum(), list(leaves.values()), allow_unused=True)
    grads = dict(zip(leaves, found, strict=True))
    assert all(grad.isfinite().all() for grad in grads.values())
    assert all((grads[name][7] == 0).all() for name in ("means", "quats", "scales", "opacities"))
    assert (grads["colors"][7] != 0).any() and (grads["viewmats"][0, :3] != 0).all()
    assert (grads["means"][8] != 0).any()


@pytest.mark.parametrize("size", [(65_537, 1), (1, 65_537), (2**40, 2**40), (20_000, 20_000)])
def test_images_beyond_reason_are_refused(size):
    inputs = scene(n=3)
    with pytest.raises(InputError, match=r"65536 pixels a side|at most 2147483648 values"):
        rasterization(**{**inputs, "width": size[0], "height": size[1]})

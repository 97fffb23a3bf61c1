"""Gradients of the engine against finite differences of the engine, in float64, away from cliffs."""

import pytest
import torch
from raster_scenes import DIFFERENTIABLE, SMOOTH, scene, without_perspective

from bigs.raster import RasterSettings, rasterization


def check(inputs, names, **options):
    leaves = [inputs[name].clone().requires_grad_() for name in names]

    def images(*values):
        colors, alphas, _ = rasterization(**{**inputs, **dict(zip(names, values, strict=True))}, **options)
        return colors, alphas

    assert torch.autograd.gradcheck(images, leaves, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("name", DIFFERENTIABLE)
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("camera_model", ["pinhole", "ortho"])
def test_every_input(name, mode, camera_model):
    inputs = scene(n=6, width=9, height=7)
    if camera_model == "ortho":
        inputs = without_perspective(inputs)
        # Wide enough that alpha is nowhere near the 1e-10 below which expected depth is no quotient.
        inputs["scales"] *= 4
    if name != "viewmats":
        check(inputs, [name], settings=SMOOTH, render_mode=mode)
        return

    # The last row of a camera is constant: only the rest may move.
    last = inputs["viewmats"][..., 3:, :]

    def images(rows):
        viewmats = torch.cat([rows, last], dim=-2)
        return rasterization(**{**inputs, "viewmats": viewmats}, settings=SMOOTH, render_mode=mode)[:2]

    rows = inputs["viewmats"][..., :3, :].clone().requires_grad_()
    assert torch.autograd.gradcheck(images, [rows], atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("mode", ["D", "ED", "RGB+D"])
def test_depth_modes(mode):
    inputs = scene(n=5, width=8, height=6)
    # Wide enough that alpha is nowhere near the 1e-10 below which expected depth is no quotient.
    inputs["scales"] *= 4
    check(inputs, ["means", "opacities", "scales"], settings=SMOOTH, render_mode=mode)


@pytest.mark.parametrize("camera_model", ["pinhole", "ortho"])
@pytest.mark.parametrize("size", [0.02, 0.2, 1.0])
def test_antialiased_opacity(size, camera_model):
    """From far below a pixel, where compensation is all there is, to well above."""
    settings = RasterSettings(alpha_threshold=0.0, min_transmittance=0.0, antialiased=True)
    inputs = scene(n=5, width=8, height=6)
    if camera_model == "ortho":
        inputs = without_perspective(inputs)
    inputs["scales"] *= size
    check(inputs, ["means", "quats", "scales", "opacities"], settings=settings)


def test_shared_and_per_frame_inputs():
    inputs = scene(n=4, width=7, height=6, batch=(3,), cameras=2)
    shared = {**inputs, **{k: inputs[k][0] for k in ("scales", "opacities", "colors", "Ks")}}
    shared["viewmats"] = inputs["viewmats"][:1]
    check(shared, ["means", "scales", "opacities", "colors"], settings=SMOOTH)


def test_limited_slope():
    # Far outside the view the Jacobian's slope is held; its gradient must be held with it.
    inputs = scene(n=4, width=10, height=8, spread=0.1)
    inputs["means"][:, 0] += torch.tensor([1.2, -1.3, 0.0, 0.0])
    inputs["means"][:, 1] += torch.tensor([0.0, 0.0, 1.2, -1.3])
    inputs["scales"] *= 5
    check(inputs, ["means", "scales"], settings=SMOOTH)


def test_many_channels():
    check(scene(n=4, channels=11, width=6, height=5), ["means", "colors", "backgrounds"], settings=SMOOTH)

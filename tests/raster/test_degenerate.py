"""Degenerate Gaussians give a finite image and finite gradients, and leave the rest of the image alone."""

import pytest
import torch
from raster_scenes import gradients, relative, scene

from bigs.raster import RasterSettings, rasterization

CASES = {
    "zero scale": ("scales", [0.0, 0.0, 0.0]),
    "one zero scale": ("scales", [0.1, 0.0, 0.1]),
    "denormal scale": ("scales", [1e-41, 1e-41, 1e-41]),
    "needle": ("scales", [1.0, 1e-6, 1e-6]),
    "disc": ("scales", [1e3, 1e3, 1e-6]),
    "huge scale": ("scales", [1e6, 1e6, 1e6]),
    "overflowing scale": ("scales", [1e30, 1e30, 1e30]),
    "negative scale": ("scales", [-0.1, 0.1, 0.1]),
    "zero quaternion": ("quats", [0.0, 0.0, 0.0, 0.0]),
    "denormal quaternion": ("quats", [1e-40, 0.0, 1e-40, 0.0]),
    "huge quaternion": ("quats", [1e30, -1e30, 1e30, 0.0]),
    "opacity 0": ("opacities", 0.0),
    "opacity 1": ("opacities", 1.0),
    "opacity beyond 1": ("opacities", 3.0),
    "negative opacity": ("opacities", -0.5),
    "behind the camera": ("means", [0.0, 0.0, -1.0]),
    "at the camera": ("means", [0.0, 0.0, 0.0]),
    "on the near plane": ("means", [0.0, 0.0, 0.01]),
    "just before the near plane": ("means", [0.0, 0.0, 0.0100001]),
    "off the screen": ("means", [50.0, 0.0, 1.0]),
    "very far": ("means", [0.0, 0.0, 1e9]),
    "astronomical": ("means", [1e30, 1e30, 1e30]),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(
    "settings",
    [
        RasterSettings(),
        RasterSettings(alpha_threshold=0.0, min_transmittance=0.0, antialiased=True),
        RasterSettings(eps2d=0.0),
    ],
    ids=["default", "no cutoffs, antialiased", "no blur"],
)
def test_finite(case, dtype, settings):
    name, value = CASES[case]
    inputs = scene(n=30, dtype=dtype)
    inputs[name][7] = torch.tensor(value, dtype=dtype)
    colors, alphas, grads = gradients(inputs, settings=settings, render_mode="RGB+ED")
    assert colors.isfinite().all() and alphas.isfinite().all()
    assert (alphas >= 0).all() and (alphas <= 1).all()
    for key, grad in grads.items():
        assert grad.isfinite().all(), key


@pytest.mark.parametrize("case", ["behind the camera", "off the screen", "opacity 0", "negative opacity"])
def test_invisible_ones_leave_the_image_alone(case):
    name, value = CASES[case]
    inputs = scene(n=30, dtype=torch.float32)
    inputs[name][7] = torch.tensor(value)
    without = {**inputs}
    for key in ("means", "quats", "scales", "opacities", "colors"):
        without[key] = torch.cat([inputs[key][:7], inputs[key][8:]])
    assert torch.equal(rasterization(**inputs).colors, rasterization(**without).colors)
    assert (rasterization(**inputs).info["radii"][0, 7] == 0).all()


def test_zero_quaternion_is_no_rotation():
    inputs = scene(n=30)
    inputs["quats"][7] = 0.0
    colors, _, grads = gradients(inputs)
    assert (grads["quats"][7] == 0).all()
    inputs["quats"][7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    assert torch.equal(colors, rasterization(**inputs).colors)


def test_needle_gradients_in_float32():
    inputs = scene(n=30, width=64, height=48)
    inputs["scales"][:, 1:] = 1e-5
    inputs["scales"][:, 0] = 1.0
    settings = RasterSettings(eps2d=0.3)
    colors, _, exact = gradients(inputs, settings=settings)
    single = {k: v.float() if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}
    rounded = {k: v.double() if isinstance(v, torch.Tensor) else v for k, v in single.items()}
    colors, _, exact = gradients(rounded, settings=settings)
    single_colors, _, grads = gradients(single, settings=settings)
    assert relative(single_colors, colors) < 1e-4
    assert relative(grads["opacities"], exact["opacities"]) < 1e-3


def test_deep_pile_keeps_its_front_gradients():
    # With no stop, transmittance underflows float32 long before the last of these layers.
    inputs = scene(n=2000, spread=0.02, width=8, height=8, dtype=torch.float32)
    inputs["scales"] += 0.3
    settings = RasterSettings(min_transmittance=0.0)
    _, _, grads = gradients(inputs, settings=settings)
    exact = {k: v.double() if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}
    _, _, expected = gradients(exact, settings=settings)
    for name in ("colors", "opacities"):
        assert relative(grads[name], expected[name]) < 1e-3


def test_equal_depths_go_by_index():
    inputs = scene(n=2, width=9, height=9, spread=0.0)
    inputs["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    inputs["means"][:] = torch.tensor([0.0, 0.0, 1.0])
    inputs["scales"][:] = 1.0
    inputs["opacities"][:] = 0.999
    colors = rasterization(**inputs).colors[0, 4, 4]
    assert relative(colors, inputs["colors"][0]) < 5e-3


def test_no_gaussians():
    colors, alphas, grads = gradients(scene(n=0), render_mode="RGB+ED")
    expected = scene(n=0)["backgrounds"][0]
    assert torch.equal(colors[..., :3], expected.expand(1, 18, 23, 3))
    assert (alphas == 0).all() and (colors[..., 3] == 0).all()
    assert grads["means"].shape == (0, 3) and (grads["viewmats"] == 0).all()
    assert (grads["backgrounds"] != 0).all()


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 37), (301, 3)])
def test_odd_images(width, height):
    inputs = scene(n=50, width=width, height=height)
    colors, alphas, grads = gradients(inputs)
    slow_colors, _, slow = gradients(inputs, backend="torch")
    assert colors.shape == (1, height, width, 3) and alphas.shape == (1, height, width, 1)
    assert relative(colors, slow_colors) < 1e-12
    assert all(relative(grads[name], slow[name]) < 1e-9 for name in grads)


def test_a_centre_at_the_end_of_numbers_without_a_threshold():
    inputs = scene(n=10, dtype=torch.float32)
    inputs["Ks"][0, 0, 2] = 3e38
    colors, alphas, grads = gradients(inputs, settings=RasterSettings(alpha_threshold=0.0))
    assert (alphas == 0).all() and torch.equal(colors, inputs["backgrounds"][:, None, None].expand_as(colors))
    assert all(grad.isfinite().all() for grad in grads.values())


@pytest.mark.parametrize("scale", [1e-120, 1e120])
def test_a_camera_in_absurd_units_is_no_singular_one(scale):
    inputs = scene(n=20)
    expected = rasterization(**inputs).colors
    inputs["viewmats"][:, :3] *= scale
    settings = RasterSettings(near_plane=1e-2 * scale, far_plane=1e10 * scale)
    assert relative(rasterization(**inputs, settings=settings).colors, expected) < 1e-12


def test_the_gradient_of_a_centre_is_finite_under_the_largest_opacity():
    inputs = scene(n=20, dtype=torch.float32)
    inputs["opacities"][3] = 3.4e38
    inputs["means"].requires_grad_()
    colors, _, info = rasterization(**inputs, means2d="full", absgrad=True)
    info["means2d"].retain_grad()
    colors.square().sum().backward()
    assert info["means2d"].grad.isfinite().all() and info["means2d"].absgrad.isfinite().all()
    assert (info["means2d"].grad != 0).any()

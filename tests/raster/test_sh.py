"""Spherical harmonics: against the general formula, finite differences, and inside a render."""

import pytest
import torch
from raster_scenes import SMOOTH, gradients, relative, scene, without_perspective

from bigs.checks import InputError
from bigs.raster import rasterization, reference, spherical_harmonics


def harmonics_scene(degree, bases=None, per_camera=False, **sizes):
    """A scene whose colours are coefficients, bright enough in places that the limit at 0 does not hold."""
    inputs = scene(**sizes)
    lead = (*inputs["viewmats"].shape[:-2], inputs["means"].shape[-2])
    if not per_camera:
        lead = inputs["means"].shape[:-1]
    g = torch.Generator().manual_seed(5)
    bases = (degree + 1) ** 2 if bases is None else bases
    coeffs = torch.randn(*lead, bases, 3, generator=g, dtype=torch.float64).to(inputs["means"].dtype)
    return {**inputs, "colors": 0.6 * coeffs, "sh_degree": degree}


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("extra", [0, 5])
def test_values(degree, extra):
    g = torch.Generator().manual_seed(degree)
    dirs = torch.randn(700, 3, generator=g, dtype=torch.float64) * torch.logspace(-3, 3, 700)[:, None]
    coeffs = torch.randn(700, (degree + 1) ** 2 + extra, 3, generator=g, dtype=torch.float64)
    exact = reference.harmonics(degree, dirs, coeffs)
    assert relative(spherical_harmonics(degree, dirs, coeffs), exact) < 1e-14
    assert relative(spherical_harmonics(degree, dirs.float(), coeffs.float()), exact) < 1e-6


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradcheck(degree):
    g = torch.Generator().manual_seed(degree)
    dirs = torch.randn(2, 5, 3, generator=g, dtype=torch.float64, requires_grad=True)
    coeffs = torch.randn(5, (degree + 1) ** 2 + 1, 3, generator=g, dtype=torch.float64, requires_grad=True)
    masks = torch.rand(2, 5, generator=g) < 0.7
    assert torch.autograd.gradcheck(lambda d, c: spherical_harmonics(degree, d, c), (dirs, coeffs))
    assert torch.autograd.gradcheck(lambda d, c: spherical_harmonics(degree, d, c, masks), (dirs, coeffs))


@pytest.mark.parametrize("lead", [(7,), (1, 7), (1, 1), (4, 1), (4, 7), ()])
def test_coefficients_are_shared_by_broadcasting(lead):
    g = torch.Generator().manual_seed(1)
    dirs = torch.randn(4, 7, 3, generator=g, dtype=torch.float64)
    coeffs = torch.randn(*lead, 16, 3, generator=g, dtype=torch.float64, requires_grad=True)
    twin = coeffs.detach().clone().requires_grad_()
    colors, expected = spherical_harmonics(3, dirs, coeffs), reference.harmonics(3, dirs, twin)
    assert relative(colors, expected) < 1e-14
    v = torch.randn(colors.shape, generator=g, dtype=torch.float64)
    colors.backward(v)
    expected.backward(v)
    assert relative(coeffs.grad, twin.grad) < 1e-13


def test_masked_colors_are_zero():
    dirs, coeffs = torch.randn(9, 3), torch.ones(9, 4, 3)
    masks = torch.arange(9) % 2 == 0
    colors = spherical_harmonics(1, dirs, coeffs, masks)
    assert (colors[~masks] == 0).all() and (colors[masks] != 0).any(-1).all()


def test_what_does_not_fit_is_named():
    dirs, coeffs = torch.randn(9, 3), torch.ones(9, 4, 3)
    with pytest.raises(InputError, match="degree: expected one of 0, 1, 2, 3, found 4"):
        spherical_harmonics(4, dirs, coeffs)
    with pytest.raises(InputError, match=r"coeffs: expected shape \[..., at least 9, 3\] for degree 2"):
        spherical_harmonics(2, dirs, coeffs)
    with pytest.raises(InputError, match=r"coeffs: expected leading axes that broadcast to those of dirs"):
        spherical_harmonics(1, dirs, coeffs[:4])
    with pytest.raises(InputError, match="dirs: expected float32 or float64 as coeffs"):
        spherical_harmonics(1, dirs.double(), coeffs)
    with pytest.raises(InputError, match=r"masks: expected bool of shape \[9\]"):
        spherical_harmonics(1, dirs, coeffs, torch.ones(3, dtype=torch.bool))
    inputs = harmonics_scene(1)
    with pytest.raises(InputError, match="colors: expected shape"):
        rasterization(**{**inputs, "sh_degree": 2})
    with pytest.raises(InputError, match="sh_degree: expected one of 0, 1, 2, 3"):
        rasterization(**{**inputs, "sh_degree": 4})
    inputs["colors"][3, 1, 0] = float("nan")
    with pytest.raises(InputError, match=r"colors: expected finite values, found nan at index \[3, 1, 0\]"):
        rasterization(**inputs)


@pytest.mark.parametrize("degree", [0, 2, 3])
@pytest.mark.parametrize(
    "sizes",
    [{}, {"cameras": 3}, {"cameras": 2, "batch": (2,)}, {"cameras": 2, "per_camera": True}],
    ids=["one", "cameras", "batch", "per camera"],
)
def test_renders_agree_with_the_twin(degree, sizes):
    inputs = harmonics_scene(degree, bases=16, n=40, width=31, height=27, **sizes)
    fast, slow = (gradients(inputs, backend=backend, render_mode="RGB+D") for backend in ("rust", "torch"))
    assert relative(fast[0], slow[0]) < 1e-12
    for name, gradient in fast[2].items():
        assert relative(gradient, slow[2][name]) < 1e-10, name
    # The camera's position turns the colours: without them its gradient is another.
    plain = {**inputs, "colors": torch.ones(40, 3, dtype=torch.float64)}
    del plain["sh_degree"]
    if degree:
        assert relative(gradients(plain, render_mode="RGB+D")[2]["viewmats"], slow[2]["viewmats"]) > 1e-3


def test_shared_coefficients_of_a_batch():
    inputs = harmonics_scene(3, n=20, cameras=2, batch=(3,))
    for name in ("colors", "scales"):
        inputs[name] = inputs[name][0]
    fast, slow = (gradients(inputs, backend=backend) for backend in ("rust", "torch"))
    assert relative(fast[0], slow[0]) < 1e-12
    for name, gradient in fast[2].items():
        assert relative(gradient, slow[2][name]) < 1e-10, name


def test_single_precision_through_parallel_rays():
    inputs = without_perspective(harmonics_scene(3, n=60, cameras=2, dtype=torch.float32))
    exact = {k: v.double() if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}
    fast, slow = gradients(inputs), gradients(exact, backend="torch")
    assert relative(fast[0], slow[0]) < 2e-6
    for name, gradient in fast[2].items():
        assert relative(gradient, slow[2][name]) < 2e-4, name


def test_degree_zero_is_a_plain_color():
    inputs = harmonics_scene(0)
    plain = {**inputs, "colors": (0.5 + 0.28209479177387814 * inputs["colors"][:, 0]).clamp(min=0)}
    del plain["sh_degree"]
    assert relative(rasterization(**inputs).colors, rasterization(**plain).colors) < 1e-14


def test_gradients_of_directions_in_a_render():
    inputs = harmonics_scene(3, n=4, width=8, height=7)
    # Away from the limit at 0, which has no derivative there.
    inputs["colors"][:, 0] += 6.0
    leaves = [inputs[name].clone().requires_grad_() for name in ("means", "colors")]

    def images(means, colors):
        return rasterization(**{**inputs, "means": means, "colors": colors}, settings=SMOOTH)[:2]

    assert torch.autograd.gradcheck(images, leaves, atol=1e-6, rtol=1e-4)

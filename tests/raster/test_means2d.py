"""Centres on screen as a tensor of the graph: their gradient, and what flows through them."""

import pytest
import torch
from raster_scenes import DIFFERENTIABLE, SMOOTH, gradients, relative, scene, without_perspective

from bigs.checks import InputError
from bigs.raster import RasterSettings, rasterization, reference


def graph_of(inputs, **options):
    leaves = {k: inputs[k].detach().clone().requires_grad_() for k in DIFFERENTIABLE}
    colors, alphas, info = rasterization(**{**inputs, **leaves}, **options)
    g = torch.Generator().manual_seed(3)
    loss = sum((x * torch.randn(x.shape, generator=g, dtype=x.dtype)).sum() for x in (colors, alphas))
    return leaves, loss, info


def twin_of(inputs, settings):
    """Image, alphas and info of the twin in double precision, and the weights of `graph_of`."""
    single = {k: v[0] for k, v in inputs.items() if k in ("viewmats", "Ks", "backgrounds")}
    double = {k: v.double() if isinstance(v, torch.Tensor) else v for k, v in {**inputs, **single}.items()}
    image, alphas, info = reference.rasterize_view(
        *(double[k].requires_grad_() for k in ("means", "quats", "scales", "opacities", "colors")),
        double["viewmats"],
        double["Ks"],
        inputs["width"],
        inputs["height"],
        settings,
        double["backgrounds"],
        None,
        "RGB",
        "pinhole",
    )
    g = torch.Generator().manual_seed(3)
    dtype = inputs["means"].dtype
    weights = [torch.randn(x.shape, generator=g, dtype=dtype).double() for x in (image, alphas)]
    return image, alphas, info, *weights


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_gradient_is_the_twins(antialiased, dtype):
    inputs = scene(n=60, width=40, height=30, dtype=dtype)
    settings = RasterSettings(antialiased=antialiased)
    _, loss, info = graph_of(inputs, settings=settings, means2d="full")
    info["means2d"].retain_grad()
    loss.backward()
    image, alphas, slow, v_image, v_alphas = twin_of(inputs, settings)
    twin_loss = (image * v_image).sum() + (alphas * v_alphas).sum()
    (expected,) = torch.autograd.grad(twin_loss, slow["means2d"])
    assert relative(info["means2d"].grad[0], expected) < (1e-10 if dtype == torch.float64 else 2e-4)
    assert relative(info["means2d"][0], slow["means2d"]) < (1e-12 if dtype == torch.float64 else 1e-6)


@pytest.mark.parametrize("ortho", [False, True])
@pytest.mark.parametrize("layout", ["full", "packed"])
def test_other_gradients_are_the_same(ortho, layout):
    inputs = scene(n=50, cameras=2, batch=(3,))
    for name in ("means", "Ks"):
        inputs[name] = inputs[name][0]
    if ortho:
        inputs = without_perspective(inputs)
    plain = gradients(inputs, render_mode="RGB+ED")
    graph = gradients(inputs, render_mode="RGB+ED", means2d=layout)
    assert torch.equal(graph[0], plain[0]) and torch.equal(graph[1], plain[1])
    for name, gradient in graph[2].items():
        assert relative(gradient, plain[2][name]) < 1e-12, name


def test_packed_is_full_without_the_unseen():
    inputs = scene(n=80, cameras=2, spread=1.0)
    found = {}
    for layout in ("full", "packed"):
        _, loss, info = graph_of(inputs, means2d=layout)
        info["means2d"].retain_grad()
        loss.backward()
        found[layout] = info
    seen = found["full"]["depths"] > 0
    assert 0 < seen.sum() < seen.numel()
    assert torch.equal(found["packed"]["means2d"], found["full"]["means2d"][seen])
    assert torch.equal(found["packed"]["means2d"].grad, found["full"]["means2d"].grad[seen])
    assert (found["full"]["means2d"].grad[~seen] == 0).all()


@pytest.mark.parametrize("ortho", [False, True])
def test_a_loss_on_the_centres_flows_on(ortho):
    inputs = scene(n=6, cameras=2, width=9, height=7)
    if ortho:
        inputs = without_perspective(inputs)
    last = inputs["viewmats"][..., 3:, :]

    def outputs(means, rows):
        moved = {**inputs, "means": means, "viewmats": torch.cat([rows, last], dim=-2)}
        colors, _, info = rasterization(**moved, settings=SMOOTH, means2d="full")
        return info["means2d"], colors + info["means2d"].square().mean()

    leaves = [x.clone().requires_grad_() for x in (inputs["means"], inputs["viewmats"][..., :3, :])]
    assert torch.autograd.gradcheck(outputs, leaves, atol=1e-5, rtol=1e-4)


def test_values_are_no_part_of_the_graph():
    _, _, info = graph_of(scene())
    assert not info["means2d"].requires_grad
    with pytest.raises(InputError, match="means2d: expected 'values' for backend 'torch'"):
        rasterization(**scene(), means2d="full", backend="torch")
    with pytest.raises(InputError, match="means2d: expected one of values, full, packed"):
        rasterization(**scene(), means2d=True)


def test_frozen_gaussians_still_have_a_gradient_on_screen():
    inputs = scene(n=20)
    colors = inputs["colors"].clone().requires_grad_()
    images, _, info = rasterization(**{**inputs, "colors": colors}, means2d="full")
    assert not info["means2d"].requires_grad
    images.sum().backward()
    assert colors.grad.abs().sum() > 0


@pytest.mark.parametrize("channels", [1, 3, 4, 7])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_absolute_gradient_is_the_twins_pixel_by_pixel(channels, dtype):
    inputs = scene(n=25, channels=channels, width=11, height=9, dtype=dtype)
    _, loss, info = graph_of(inputs, means2d="full", absgrad=True)
    info["means2d"].retain_grad()
    loss.backward()
    image, alphas, slow, v_image, v_alphas = twin_of(inputs, RasterSettings())
    expected = torch.zeros_like(slow["means2d"])
    for row in range(9):
        for column in range(11):
            at = row, column
            pixel = (image[at] * v_image[at]).sum() + (alphas[at] * v_alphas[at]).sum()
            expected += torch.autograd.grad(pixel, slow["means2d"], retain_graph=True)[0].abs()
    assert relative(info["means2d"].absgrad[0], expected) < (1e-10 if dtype == torch.float64 else 2e-4)
    assert (info["means2d"].absgrad >= info["means2d"].grad.abs() * (1 - 1e-4)).all()


def test_absolute_gradients_change_nothing_else():
    inputs = scene(n=80, cameras=2, spread=1.0)
    found = {}
    for layout, absgrad in (("full", False), ("full", True), ("packed", True)):
        leaves, loss, info = graph_of(inputs, means2d=layout, absgrad=absgrad, render_mode="RGB+ED")
        info["means2d"].retain_grad()
        loss.backward()
        found[layout, absgrad] = info["means2d"], [leaf.grad for leaf in leaves.values()]
    plain, absolute, packed = found.values()
    assert not hasattr(plain[0], "absgrad")
    seen = absolute[0].absgrad.sum(-1) > 0
    assert packed[0].absgrad.shape == packed[0].shape
    assert torch.equal(packed[0].absgrad[packed[0].absgrad.sum(-1) > 0], absolute[0].absgrad[seen])
    for a, b in zip(plain[1], absolute[1], strict=True):
        assert relative(b, a) < 1e-12
    with pytest.raises(InputError, match="absgrad: expected means2d 'full' or 'packed' with it"):
        rasterization(**inputs, absgrad=True)

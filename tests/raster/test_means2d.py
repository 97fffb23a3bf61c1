"""Centres on screen as a tensor of the graph: their gradient, and what flows through them."""

import pytest
import torch
from raster_scenes import DIFFERENTIABLE, SMOOTH, gradients, relative, scene, without_perspective

from bigs.checks import InputError
from bigs.raster import rasterization, reference


def graph_of(inputs, **options):
    leaves = {k: inputs[k].detach().clone().requires_grad_() for k in DIFFERENTIABLE}
    colors, alphas, info = rasterization(**{**inputs, **leaves}, **options)
    g = torch.Generator().manual_seed(3)
    loss = sum((x * torch.randn(x.shape, generator=g, dtype=x.dtype)).sum() for x in (colors, alphas))
    return leaves, loss, info


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_gradient_is_the_twins(antialiased, dtype):
    inputs = scene(n=60, width=40, height=30, dtype=dtype)
    settings = SMOOTH.__class__(antialiased=antialiased)
    _, loss, info = graph_of(inputs, settings=settings, means2d="full")
    info["means2d"].retain_grad()
    loss.backward()
    single = {k: v[0] for k, v in inputs.items() if k in ("viewmats", "Ks", "backgrounds")}
    double = {k: v.double() if isinstance(v, torch.Tensor) else v for k, v in {**inputs, **single}.items()}
    image, alphas, slow = reference.rasterize_view(
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
    twin_loss = sum((x * torch.randn(x.shape, generator=g, dtype=dtype)).sum() for x in (image, alphas))
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

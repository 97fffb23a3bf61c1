"""The door to the GPU: what gsplat is asked for, and that it answers as the engine does."""

import dataclasses

import pytest
import torch
from raster_scenes import DIFFERENTIABLE, relative, scene, without_perspective

from bigs.checks import InputError
from bigs.raster import RasterSettings, rasterization
from bigs.raster import gsplat as drop_in


def test_gsplat_is_named_when_missing(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gsplat", None)
    with pytest.raises(InputError, match="pip install gsplat"):
        rasterization(**scene(), backend="gsplat")


class FakeGsplat:
    """Stands in for the CUDA library: same call, rendered by the twin."""

    def __init__(self):
        self.layout = None

    def rasterization(self, *, rasterize_mode, packed, absgrad, backgrounds, **call):
        self.layout = packed, absgrad
        assert backgrounds is None or not packed  # gsplat 1.5 expects one colour for all cameras there
        rules = ("near_plane", "far_plane", "radius_clip", "eps2d", "tile_size")
        settings = RasterSettings(
            **{name: call.pop(name) for name in rules},
            antialiased=rasterize_mode == "antialiased",
        )
        return rasterization(**call, backgrounds=backgrounds, settings=settings, backend="torch")


@pytest.fixture
def fake(monkeypatch):
    library = FakeGsplat()
    monkeypatch.setattr("bigs.raster.cuda._gsplat", lambda: library)
    return library


def with_harmonics(inputs, degree):
    n = inputs["means"].shape[-2]
    g = torch.Generator().manual_seed(2)
    coeffs = torch.rand(n, (degree + 1) ** 2, 3, generator=g, dtype=torch.float64).to(inputs["means"].dtype)
    return {**inputs, "colors": coeffs, "sh_degree": degree}


@pytest.mark.parametrize("ortho", [False, True])
@pytest.mark.parametrize("degree", [None, 2])
@pytest.mark.parametrize("antialiased", [False, True])
def test_gsplat_receives_the_call(fake, ortho, degree, antialiased):
    inputs = scene(n=30, batch=(2,))
    inputs["colors"] = inputs["colors"][0]
    if ortho:
        inputs = without_perspective(inputs)
    if degree is not None:
        inputs = with_harmonics(inputs, degree)
    mask = torch.rand(2, 1, 18, 23) < 0.5
    settings = RasterSettings(
        antialiased=antialiased, radius_clip=2.0, eps2d=0.2, near_plane=0.9, far_plane=1.5, tile_size=8
    )
    call = {**inputs, "pixel_mask": mask, "settings": settings, "render_mode": "RGB+D"}
    through, direct = (rasterization(**call, backend=backend) for backend in ("gsplat", "rust"))
    assert relative(through.colors, direct.colors) < 1e-12
    assert relative(through.alphas, direct.alphas) < 1e-12


@pytest.mark.parametrize("means2d", ["values", "packed"])
@pytest.mark.parametrize("render_mode", ["RGB", "D"])
def test_backgrounds_are_those_of_the_engine(fake, means2d, render_mode):
    """With their gradients: where nothing is rendered there is none."""
    inputs, mask = scene(n=30), torch.rand(1, 18, 23) < 0.5
    found = []
    for backend in ("gsplat", "torch"):
        backgrounds = inputs["backgrounds"].clone().requires_grad_()
        layout = means2d if backend == "gsplat" else "values"
        call = {**inputs, "backgrounds": backgrounds, "pixel_mask": mask, "render_mode": render_mode}
        colors = rasterization(**call, means2d=layout, backend=backend).colors
        if render_mode == "RGB":
            colors.sum().backward()
            found.append((colors, backgrounds.grad))
        else:
            found.append((colors,))
    for through, direct in zip(*found, strict=True):
        assert relative(through, direct) < 1e-12


@pytest.mark.parametrize("means2d", ["values", "full", "packed"])
@pytest.mark.parametrize("absgrad", [False, True])
def test_gsplat_receives_the_layout(fake, means2d, absgrad):
    if absgrad and means2d == "values":
        return
    through = rasterization(
        **scene(), means2d=means2d, absgrad=absgrad, render_mode="RGB+D", backend="gsplat"
    )
    direct = rasterization(**scene(), render_mode="RGB+D", backend="torch")
    assert fake.layout == (means2d == "packed", absgrad)
    assert relative(through.colors, direct.colors) < 1e-12


@pytest.mark.parametrize("name", ["max_alpha", "alpha_threshold", "min_transmittance", "exp_degree"])
def test_gsplats_constants_are_named(fake, name):
    settings = dataclasses.replace(RasterSettings(), **{name: 4 if name == "exp_degree" else 0.5})
    with pytest.raises(InputError, match=rf"settings\.{name}: expected gsplat's constant"):
        rasterization(**scene(), settings=settings, backend="gsplat")


def on(device, inputs):
    return {k: v.to(device) if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}


def rendered(inputs, **options):
    """Colours, alphas, gradients, and gradients on screen, all on the CPU."""
    leaves = {k: inputs[k].detach().clone().requires_grad_() for k in DIFFERENTIABLE if k != "viewmats"}
    colors, alphas, info = rasterization(**{**inputs, **leaves}, means2d="full", absgrad=True, **options)
    info["means2d"].retain_grad()
    g = torch.Generator().manual_seed(0)
    loss = sum((x.cpu() * torch.randn(x.shape, generator=g)).sum() for x in (colors, alphas))
    loss.backward()
    found = {name: leaf.grad for name, leaf in leaves.items()}
    found |= {"colors of pixels": colors, "alphas": alphas}
    found |= {"means2d": info["means2d"].grad, "absgrad": info["means2d"].absgrad}
    return {name: tensor.detach().cpu() for name, tensor in found.items()}


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize(
    ("degree", "ortho", "options"),
    [
        (None, False, {}),
        (None, False, {"settings": RasterSettings(antialiased=True)}),
        (None, True, {"render_mode": "RGB+D"}),
        (0, False, {}),
        (3, False, {"render_mode": "RGB+ED"}),
    ],
    ids=["plain", "antialiased", "orthographic", "constant harmonics", "harmonics"],
)
def test_cuda_agrees_with_rust(degree, ortho, options):
    pytest.importorskip("gsplat")
    inputs = scene(n=200, cameras=2, width=64, height=48, dtype=torch.float32)
    if ortho:
        inputs = without_perspective(inputs)
    if degree is not None:
        inputs = with_harmonics(inputs, degree)
    here, there = rendered(inputs, **options), rendered(on("cuda", inputs), **options)
    for name, expected in here.items():
        tolerance = 1e-5 if name in ("colors of pixels", "alphas") else 1e-3
        assert relative(there[name], expected) < tolerance, name


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("packed", [False, True])
def test_drop_in_is_gsplat_on_cuda(packed):
    gsplat = pytest.importorskip("gsplat")
    inputs = on("cuda", scene(n=200, cameras=2, dtype=torch.float32))
    ours = drop_in.rasterization(**inputs, packed=packed)
    theirs = gsplat.rasterization(**inputs, packed=False)
    assert relative(ours[0], theirs[0]) < 1e-6
    without = {name: value for name, value in inputs.items() if name != "backgrounds"}
    assert ours[2]["means2d"].shape == gsplat.rasterization(**without, packed=packed)[2]["means2d"].shape

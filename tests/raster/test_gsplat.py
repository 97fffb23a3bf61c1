"""gsplat's own call: its arguments, its meta, and the statistics that its densification reads."""

import inspect

import pytest
import torch
from raster_scenes import relative, scene

from bigs.checks import InputError
from bigs.raster import RasterSettings
from bigs.raster import rasterization as own
from bigs.raster.gsplat import rasterization

ARGUMENTS = [
    "means",
    "quats",
    "scales",
    "opacities",
    "colors",
    "viewmats",
    "Ks",
    "width",
    "height",
    "near_plane",
    "far_plane",
    "radius_clip",
    "eps2d",
    "sh_degree",
    "packed",
    "tile_size",
    "backgrounds",
    "render_mode",
    "sparse_grad",
    "absgrad",
    "rasterize_mode",
    "channel_chunk",
    "distributed",
    "camera_model",
    "segmented",
    "covars",
    "with_ut",
    "with_eval3d",
    "radial_coeffs",
    "tangential_coeffs",
    "thin_prism_coeffs",
    "ftheta_coeffs",
    "rolling_shutter",
    "viewmats_rs",
]


def test_signature_is_gsplats():
    found = inspect.signature(rasterization).parameters
    assert list(found) == ARGUMENTS
    assert all(p.kind == inspect.Parameter.POSITIONAL_OR_KEYWORD for p in found.values())
    gsplat = pytest.importorskip("gsplat.rendering", reason="compares with gsplat where it is installed")
    for name, expected in inspect.signature(gsplat.rasterization).parameters.items():
        if name != "rolling_shutter":
            assert found[name].default == expected.default, name


@pytest.mark.parametrize("packed", [True, False])
def test_arguments_arrive(packed):
    inputs = scene(n=60, cameras=2, width=40, height=30)
    inputs["colors"] = torch.rand(60, 9, 3, generator=torch.Generator().manual_seed(2)).double()
    order = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height")
    colors, alphas, meta = rasterization(
        *(inputs[name] for name in order),
        0.9,
        1.5,
        2.0,
        0.2,
        2,
        packed,
        8,
        inputs["backgrounds"],
        "RGB+ED",
        rasterize_mode="antialiased",
        camera_model="ortho",
        channel_chunk=2,
        segmented=True,
    )
    settings = RasterSettings(
        near_plane=0.9, far_plane=1.5, radius_clip=2.0, eps2d=0.2, tile_size=8, antialiased=True
    )
    expected = own(**inputs, settings=settings, sh_degree=2, render_mode="RGB+ED", camera_model="ortho")
    assert torch.equal(colors, expected.colors) and torch.equal(alphas, expected.alphas)
    assert meta["tile_size"] == 8 and meta["tile_width"] == 5 and meta["tile_height"] == 4


def test_meta_layouts():
    inputs = scene(n=80, cameras=3, batch=(2,), spread=1.0)
    full = rasterization(**inputs, packed=False)[2]
    packed = rasterization(**inputs)[2]
    seen = full["depths"] > 0
    assert 0 < seen.sum() < seen.numel()
    assert full["batch_ids"] is full["camera_ids"] is full["gaussian_ids"] is None
    where = packed["batch_ids"], packed["camera_ids"], packed["gaussian_ids"]
    for name in ("means2d", "depths", "radii", "opacities"):
        assert full[name].shape[:3] == (2, 3, 80)
        assert torch.equal(packed[name], full[name][where])
    assert torch.equal(packed["opacities"], inputs["opacities"][where[0], where[2]])
    for meta in (full, packed):
        assert (meta["width"], meta["height"], meta["n_cameras"], meta["n_batches"]) == (23, 18, 3, 2)


@pytest.mark.parametrize("packed", [True, False])
def test_statistics_of_densification(packed):
    inputs = scene(n=50, cameras=2)
    inputs["means"].requires_grad_()
    colors, _, meta = rasterization(**inputs, packed=packed)
    meta["means2d"].retain_grad()
    (through,) = torch.autograd.grad(colors.square().sum(), inputs["means"], retain_graph=True)
    colors.square().sum().backward()
    assert meta["means2d"].grad.shape == meta["means2d"].shape and meta["means2d"].grad.abs().sum() > 0
    assert relative(inputs["means"].grad, through) < 1e-14
    (plain,) = torch.autograd.grad(own(**inputs).colors.square().sum(), inputs["means"])
    assert relative(inputs["means"].grad, plain) < 1e-12


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sparse_grad", True),
        ("distributed", True),
        ("covars", torch.eye(3).repeat(12, 1, 1)),
        ("with_ut", True),
        ("with_eval3d", True),
        ("radial_coeffs", torch.zeros(1, 4)),
        ("tangential_coeffs", torch.zeros(1, 2)),
        ("thin_prism_coeffs", torch.zeros(1, 4)),
        ("ftheta_coeffs", object()),
        ("rolling_shutter", "ROLLING_TOP_TO_BOTTOM"),
        ("viewmats_rs", torch.eye(4)[None]),
        ("camera_model", "fisheye"),
        ("camera_model", "ftheta"),
        ("rasterize_mode", "best"),
        ("render_mode", "N"),
    ],
)
def test_what_is_not_supported_is_named(name, value):
    with pytest.raises(InputError, match=f"^{name}: expected"):
        rasterization(**scene(), **{name: value})


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("absgrad", [True, False])
def test_strategy_of_gsplat(packed, absgrad):
    strategy_module = pytest.importorskip(
        "gsplat.strategy", reason="runs gsplat's own densification if installed"
    )
    torch.manual_seed(0)
    inputs = scene(n=40, cameras=2, dtype=torch.float32)
    params = torch.nn.ParameterDict(
        {
            "means": inputs["means"],
            "scales": inputs["scales"].log(),
            "quats": inputs["quats"],
            "opacities": inputs["opacities"].logit(),
            "colors": inputs["colors"],
        }
    )
    optimizers = {name: torch.optim.Adam([value], lr=1e-3) for name, value in params.items()}
    strategy = strategy_module.DefaultStrategy(
        refine_start_iter=0, refine_every=2, grow_grad2d=1e-4, absgrad=absgrad
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    for step in range(4):
        colors, _, meta = rasterization(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid(),
            params["colors"],
            inputs["viewmats"],
            inputs["Ks"],
            inputs["width"],
            inputs["height"],
            packed=packed,
            absgrad=absgrad,
        )
        strategy.step_pre_backward(params, optimizers, state, step, meta)
        (colors - 0.5).square().mean().backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        strategy.step_post_backward(params, optimizers, state, step, meta, packed=packed)
    assert len(params["means"]) > 40

"""The engine against its slow torch twin, which shares no code with it."""

import pytest
import torch
from raster_scenes import gradients, relative, scene, without_perspective

from bigs.raster import RasterSettings, rasterization

TOLERANCE = {torch.float64: (1e-12, 1e-10), torch.float32: (2e-6, 2e-4)}


def compare(inputs, **options):
    colors, alphas, grads = gradients(inputs, backend="rust", **options)
    exact = {
        k: v.double() if isinstance(v, torch.Tensor) and v.is_floating_point() else v
        for k, v in inputs.items()
    }
    slow_colors, slow_alphas, slow_grads = gradients(exact, backend="torch", **options)
    image_tolerance, gradient_tolerance = TOLERANCE[inputs["means"].dtype]
    assert colors.shape == slow_colors.shape and alphas.shape == slow_alphas.shape
    assert relative(colors, slow_colors) < image_tolerance
    assert relative(alphas, slow_alphas) < image_tolerance
    for name, grad in grads.items():
        assert grad.shape == inputs[name].shape
        assert relative(grad, slow_grads[name]) < gradient_tolerance, name


@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("channels", [1, 3, 6])
def test_modes_and_channels(mode, channels):
    compare(scene(n=150, channels=channels, width=45, height=38), render_mode=mode)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("channels", [2, 5, 8, 9, 17])
def test_channel_groups(channels, dtype):
    compare(scene(n=60, channels=channels, width=20, height=21, dtype=dtype), render_mode="RGB+D")


@pytest.mark.parametrize("batch", [(2,), (2, 3)])
def test_batches(batch):
    compare(scene(n=30, batch=batch, cameras=2))


def test_shared_inputs():
    inputs = scene(n=40, batch=(3,), cameras=2)
    for name in ("scales", "opacities", "colors", "Ks"):
        inputs[name] = inputs[name][0]
    inputs["viewmats"] = inputs["viewmats"][:1]
    inputs["quats"] = inputs["quats"][:1]
    compare(inputs, render_mode="RGB+D")


def test_partial_broadcast():
    inputs = scene(n=20, batch=(2, 3))
    inputs["means"] = inputs["means"][:1]
    inputs["quats"] = inputs["quats"][:, :1]
    compare(inputs)


def test_colors_per_camera():
    inputs = scene(n=30, cameras=3)
    compare({**inputs, "colors": torch.rand(3, 30, 4).double(), "backgrounds": torch.rand(3, 4).double()})


def test_colors_per_camera_shared_by_the_batch():
    inputs = scene(n=30, cameras=3, batch=(2,))
    compare({**inputs, "colors": torch.rand(1, 3, 30, 3).double()})


def test_no_background():
    compare({**scene(n=50), "backgrounds": None})


# A faint image is 1 - T with T next to 1: single precision has few digits left of it.
@pytest.mark.parametrize(
    ("size", "dtype"), [(1.0, torch.float32), (1.0, torch.float64), (0.02, torch.float64)]
)
def test_antialiased(size, dtype):
    inputs = scene(n=120, dtype=dtype)
    inputs["scales"] = inputs["scales"] * size * torch.tensor([1.0, 0.3, 0.01], dtype=dtype)
    compare(inputs, settings=RasterSettings(antialiased=True, alpha_threshold=1e-4))


@pytest.mark.parametrize("tile_size", [4, 8, 16, 32])
def test_tile_sizes_and_no_cutoffs(tile_size):
    settings = RasterSettings(tile_size=tile_size, alpha_threshold=0.0, min_transmittance=0.0)
    compare(scene(n=40, width=33, height=19), settings=settings)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_orthographic(dtype):
    inputs = without_perspective(scene(n=150, cameras=2, width=45, height=38, dtype=dtype))
    compare(inputs, render_mode="RGB+D")
    compare(inputs, settings=RasterSettings(antialiased=True, near_plane=1.0, far_plane=1.4))


def test_opaque_pile_stops_early():
    inputs = scene(n=300, spread=0.05)
    inputs["opacities"] = 0.5 + 0.6 * torch.rand(300).double()  # beyond max_alpha as well
    compare(inputs)


def test_radius_clip_and_planes():
    compare(scene(n=100), settings=RasterSettings(radius_clip=6.0, near_plane=1.0, far_plane=1.4))


def test_pixel_mask():
    inputs = scene(n=80, cameras=2, width=40, height=35)
    mask = torch.rand(2, 35, 40, generator=torch.Generator().manual_seed(1)) < 0.4
    mask[:, :16, :16] = False
    compare({**inputs, "pixel_mask": mask}, render_mode="RGB+ED")


def test_masked_pixels_show_the_background():
    inputs = scene(n=80, width=40, height=35)
    mask = torch.zeros(1, 35, 40, dtype=torch.bool)
    colors, alphas, info = rasterization(**inputs, pixel_mask=mask)
    assert torch.equal(colors, inputs["backgrounds"][:, None, None].expand_as(colors))
    assert (alphas == 0).all() and info["n_isects"] == 0
    _, _, grads = gradients({**inputs, "pixel_mask": mask})
    assert all((grad == 0).all() for grad in grads.values())


def test_info_agrees():
    inputs = scene(n=60, cameras=2, batch=(2,))
    fast, slow = (rasterization(**inputs, backend=backend).info for backend in ("rust", "torch"))
    assert torch.equal(fast["radii"], slow["radii"])
    assert fast["radii"].shape == (2, 2, 60, 2)
    for name in ("means2d", "depths"):
        assert relative(fast[name], slow[name]) < 1e-12
    assert fast["n_visible"] == (slow["depths"] > 0).sum()

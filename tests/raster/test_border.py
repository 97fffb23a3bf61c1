"""What the call refuses, in which words, and what it does not copy."""

import dataclasses

import numpy as np
import pytest
import torch
from raster_scenes import scene

from bigs import _raster
from bigs.checks import InputError
from bigs.raster import RasterSettings, rasterization, rust

BAD_VALUES = [
    ("means", (5, 1), float("nan")),
    ("quats", (2, 3), float("inf")),
    ("scales", (11, 0), float("-inf")),
    ("opacities", (4,), float("nan")),
    ("colors", (0, 2), float("nan")),
    ("viewmats", (0, 1, 2), float("nan")),
    ("Ks", (0, 0, 2), float("inf")),
    ("backgrounds", (0, 1), float("nan")),
]


@pytest.mark.parametrize("backend", ["rust", "torch"])
@pytest.mark.parametrize(("name", "index", "value"), BAD_VALUES)
def test_poison_is_named(name, index, value, backend):
    inputs = scene()
    inputs[name][index] = value
    with pytest.raises(InputError) as error:
        rasterization(**inputs, backend=backend)
    assert str(error.value).startswith(f"{name}: expected finite values")
    assert str(list(index)) in str(error.value)


@pytest.mark.parametrize(
    ("name", "shape", "words"),
    [
        ("means", (12, 2), r"means: expected shape \[..., 12, 3\], found \[12, 2\]"),
        ("means", (3,), r"means: expected shape"),
        ("quats", (11, 4), r"quats: expected shape \[..., 12, 4\], found \[11, 4\]"),
        ("scales", (12,), r"scales: expected shape"),
        ("opacities", (12, 1), r"opacities: expected shape \[..., 12\], found \[12, 1\]"),
        ("colors", (12, 0), r"colors: expected at least one"),
        ("colors", (2, 12, 3), r"colors: expected shape \[1, 12, 3\], found \[2, 12, 3\]"),
        ("viewmats", (1, 3, 4), r"viewmats: expected shape"),
        ("Ks", (2, 3, 3), r"Ks: expected shape \[..., 1, 3, 3\], found \[2, 3, 3\]"),
        ("backgrounds", (1, 4), r"backgrounds: expected shape \[..., 1, 3\], found \[1, 4\]"),
    ],
)
def test_shapes_are_named(name, shape, words):
    with pytest.raises(InputError, match=words):
        rasterization(**{**scene(), name: torch.zeros(shape, dtype=torch.float64)})


@pytest.mark.parametrize("backend", ["rust", "torch"])
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"width": 1 << 20, "height": 1 << 20}, "width and height: expected at most"),
        ({"width": 1 << 40, "height": 1}, "width and height: expected at most"),
        (
            {
                "height": 1 << 14,
                "width": 1 << 14,
                "colors": torch.zeros(1, 1, dtype=torch.float64).expand(12, 100),
            },
            "100 channels",
        ),
        ({"means": torch.zeros(1, 1, 3, dtype=torch.float64).expand(1 << 30, 12, 3)}, "expected at most"),
    ],
)
def test_images_that_no_memory_holds(changes, words, backend):
    with pytest.raises(InputError, match=words):
        rasterization(**{**scene(), "backgrounds": None, **changes}, backend=backend)


def test_batches_that_do_not_broadcast():
    inputs = scene(batch=(2,))
    inputs["quats"] = inputs["quats"].repeat(2, 1, 1)[:3]
    with pytest.raises(InputError, match="batch axes: expected shapes that broadcast"):
        rasterization(**inputs)


def test_dtypes_are_named():
    with pytest.raises(
        InputError, match=r"scales: expected the dtype of means, torch.float64, found torch.float32"
    ):
        rasterization(**{**scene(), "scales": scene()["scales"].float()})
    with pytest.raises(InputError, match=r"colors: expected dtype float32 or float64, found torch.float16"):
        rasterization(**{**scene(), "colors": scene()["colors"].half()})
    with pytest.raises(InputError, match="means: expected a torch tensor, found ndarray"):
        rasterization(**{**scene(), "means": np.zeros((12, 3))})
    with pytest.raises(InputError, match=r"pixel_mask: expected a bool tensor, found torch.float32"):
        rasterization(**scene(), pixel_mask=torch.ones(1, 18, 23))


def test_cameras_are_named():
    inputs = scene(cameras=2)
    inputs["viewmats"][1, :3, 0] = inputs["viewmats"][1, :3, 1]
    with pytest.raises(InputError, match=r"viewmats: expected an invertible .* at index \[1\]"):
        rasterization(**inputs)
    inputs = scene(cameras=2)
    inputs["viewmats"][1, 3, 0] = 1.0
    with pytest.raises(InputError, match=r"viewmats: expected 0 0 0 1 as the last row"):
        rasterization(**inputs)
    for index, value, words in [
        ((0, 0), -1.0, "positive focal"),
        ((0, 1), 2.0, "no skew"),
        ((2, 2), 2.0, "0 0 1"),
    ]:
        inputs = scene(cameras=2)
        inputs["Ks"][1][index] = value
        with pytest.raises(InputError, match=f"Ks: expected {words}"):
            rasterization(**inputs)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tile_size": 12}, "settings.tile_size: expected 4, 8, 16 or 32"),
        ({"exp_degree": 2}, "settings.exp_degree: expected 3, 4 or 5"),
        ({"exp_degree": 4}, "settings.exp_degree: expected 5 with 64-bit floats"),
        ({"max_alpha": 1.0}, r"settings.max_alpha: expected a number in \(0, 1\)"),
        ({"alpha_threshold": -0.1}, "settings.alpha_threshold"),
        ({"min_transmittance": 1.0}, "settings.min_transmittance"),
        ({"near_plane": 0.0}, "settings.near_plane"),
        ({"far_plane": 0.001}, "settings.far_plane"),
        ({"eps2d": float("nan")}, "settings.eps2d"),
    ],
)
def test_settings_are_named(change, words):
    with pytest.raises(InputError, match=words):
        rasterization(**scene(), settings=RasterSettings(**change))


def test_choices_are_named():
    with pytest.raises(InputError, match="render_mode: expected one of RGB"):
        rasterization(**scene(), render_mode="depth")
    with pytest.raises(InputError, match="camera_model: expected one of pinhole, ortho"):
        rasterization(**scene(), camera_model="fisheye")
    with pytest.raises(InputError, match="backend: expected one of auto"):
        rasterization(**scene(), backend="cuda")
    with pytest.raises(InputError, match="width: expected a positive whole number of pixels, found 0"):
        rasterization(**{**scene(), "width": 0})


def test_defaults_exist_once():
    assert dataclasses.asdict(RasterSettings()) == _raster.default_settings()


def test_contiguous_inputs_are_not_copied(monkeypatch):
    inputs = scene(n=40, batch=(2,))
    inputs["scales"] = inputs["scales"][0]
    seen = {}
    forward = _raster.rasterize_forward

    def spy(arrays, *call):
        names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")
        seen.update({name: array.ctypes.data for name, array in zip(names, arrays, strict=False)})
        return forward(arrays, *call)

    monkeypatch.setattr(rust._raster, "rasterize_forward", spy)
    rasterization(**inputs)
    assert seen == {name: inputs[name].data_ptr() for name in seen} and len(seen) == 8


def test_strided_inputs_are_right():
    inputs = scene(n=40)
    strided = {**inputs}
    for name in ("means", "quats", "colors"):
        strided[name] = inputs[name].T.contiguous().T
        assert not strided[name].is_contiguous()
    assert torch.equal(rasterization(**strided).colors, rasterization(**inputs).colors)


def test_only_what_needs_a_gradient_gets_one():
    inputs = scene(n=40)
    inputs["means"].requires_grad_()
    inputs["backgrounds"].requires_grad_()
    colors, alphas, _ = rasterization(**inputs)
    (colors.sum() + alphas.sum()).backward()
    assert inputs["means"].grad is not None and inputs["backgrounds"].grad is not None
    assert all(inputs[name].grad is None for name in ("quats", "scales", "opacities", "colors", "viewmats"))


def test_a_loss_on_alpha_or_color_alone():
    inputs = scene(n=40)
    inputs["opacities"].requires_grad_()
    colors, alphas, _ = rasterization(**inputs)
    (of_alpha,) = torch.autograd.grad(alphas.sum(), inputs["opacities"], retain_graph=True)
    (of_color,) = torch.autograd.grad(colors.sum(), inputs["opacities"], retain_graph=True)
    (of_both,) = torch.autograd.grad(colors.sum() + alphas.sum(), inputs["opacities"])
    assert of_alpha.abs().sum() > 0
    assert torch.allclose(of_alpha + of_color, of_both, rtol=1e-12)


def test_tiles_without_gradient_are_skipped_and_counted():
    inputs = scene(n=200, width=64, height=64)
    inputs["means"].requires_grad_()
    colors, _, info = rasterization(**inputs)
    colors[0, :16].sum().backward()
    assert info["n_tiles_without_gradient"] == 4 - info["n_empty_tiles"] - 2


def test_saturated_pixels_are_counted():
    inputs = scene(n=4, channels=9, cameras=2)
    inputs["scales"] = inputs["scales"] + 100
    inputs["opacities"] = torch.ones_like(inputs["opacities"])
    mask = torch.ones(2, 18, 23, dtype=torch.bool)
    mask[1, :, 3:20] = False
    assert rasterization(**inputs).info["n_saturated"] == mask.numel()
    assert rasterization(**inputs, pixel_mask=mask).info["n_saturated"] == mask.sum()
    endless = RasterSettings(min_transmittance=0)
    assert rasterization(**inputs, settings=endless).info["n_saturated"] == 0


def test_skipped_gradients_are_named():
    inputs = scene(n=4)
    for name in ("means", "colors", "backgrounds"):
        inputs[name].requires_grad_()
    colors, _, info = rasterization(**inputs)
    colors.sum().backward()
    assert info["gradients_skipped"] == ("quats", "scales", "opacities", "viewmats")


def test_unpacks_as_three_values():
    colors, alphas, info = rasterization(**scene(cameras=2))
    assert colors.shape == (2, 18, 23, 3) and alphas.shape == (2, 18, 23, 1)
    assert info["n_isects"] > 0 and info["tile_size"] == 32


def test_arrays_in_fortran_order_are_refused(monkeypatch):
    """Their values lie at other places; the door that tensors take copies them, this one is behind it."""
    calls = []
    forward = _raster.rasterize_forward
    monkeypatch.setattr(
        rust._raster, "rasterize_forward", lambda *given: calls.append(given) or forward(*given)
    )
    inputs = scene(n=40)
    rasterization(**inputs)
    (arrays, *others) = calls[0]
    for place, name in enumerate(("means", "quats", "scales")):
        turned = list(arrays)
        turned[place] = np.asfortranarray(turned[place])
        with pytest.raises(ValueError, match=f"{name}: expected a C-contiguous array"):
            forward(tuple(turned), *others)


def test_tensors_that_numpy_cannot_hold():
    inputs = scene()
    plain = rasterization(**inputs).colors
    turned = {**inputs, "colors": torch._neg_view(-inputs["colors"])}
    assert torch.equal(rasterization(**turned).colors, plain)
    with pytest.raises(InputError, match=r"means: expected a dense tensor, found layout torch\.sparse_coo"):
        rasterization(**{**inputs, "means": inputs["means"].to_sparse()})
    with pytest.raises(InputError, match="settings: expected RasterSettings, found dict"):
        rasterization(**inputs, settings={"tile_size": 16})

"""What must hold for every scene."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from raster_scenes import gradients, relative, scene, without_perspective

from bigs.raster import RasterSettings, rasterization

seeds = st.integers(0, 2**31)


def rotation(seed: int) -> torch.Tensor:
    """A quaternion w x y z and its matrix."""
    q = torch.nn.functional.normalize(
        torch.randn(4, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)), dim=0
    )
    w, v = q[0], q[1:]
    eye = torch.eye(3, dtype=torch.float64)
    columns = [(w * w - v @ v) * e + 2 * v * (v @ e) + 2 * w * torch.linalg.cross(v, e) for e in eye]
    return q, torch.stack(columns, dim=1)


def product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """a · b for quaternions w x y z."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    vector = aw * bv + bw * av + torch.linalg.cross(av.expand_as(bv), bv)
    return torch.cat([aw * bw - (av * bv).sum(-1, keepdim=True), vector], dim=-1)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_order_of_gaussians_does_not_matter(seed):
    inputs = scene(n=60, seed=seed)
    order = torch.randperm(60, generator=torch.Generator().manual_seed(seed))
    moved = {**inputs}
    for name in ("means", "quats", "scales", "opacities", "colors"):
        moved[name] = inputs[name][order]
    colors, _, grads = gradients(inputs)
    moved_colors, _, moved_grads = gradients(moved)
    assert torch.equal(colors, moved_colors)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert torch.equal(grads[name][order], moved_grads[name])


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_moving_world_and_camera_together_changes_nothing(seed):
    inputs = scene(n=60, seed=seed)
    q, R = rotation(seed)
    t = torch.tensor([0.3, -2.0, 5.0], dtype=torch.float64)
    world_from_moved = torch.eye(4, dtype=torch.float64)
    world_from_moved[:3, :3] = R.T
    world_from_moved[:3, 3] = -R.T @ t
    moved = {
        **inputs,
        "means": inputs["means"] @ R.T + t,
        "quats": product(q, inputs["quats"]),
        "viewmats": inputs["viewmats"] @ world_from_moved,
    }
    still, moving = rasterization(**inputs), rasterization(**moved)
    # A pair on a threshold may fall on either side of it; none does at this size of scene and rounding.
    assert relative(moving.colors, still.colors) < 1e-9
    assert relative(moving.alphas, still.alphas) < 1e-9


@settings(max_examples=20, deadline=None)
@given(seeds, st.floats(-3, 3), st.floats(-3, 3))
def test_linear_in_colors_and_background(seed, a, b):
    inputs, other = scene(n=40, seed=seed), scene(n=40, seed=seed + 1)

    def render(colors, backgrounds):
        return rasterization(**{**inputs, "colors": colors, "backgrounds": backgrounds}).colors

    mixed = render(
        a * inputs["colors"] + b * other["colors"], a * inputs["backgrounds"] + b * other["backgrounds"]
    )
    parts = a * render(inputs["colors"], inputs["backgrounds"]) + b * render(
        other["colors"], other["backgrounds"]
    )
    assert (mixed - parts).abs().max() < 1e-12


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_white_on_white_is_white_and_culling_is_invisible(seed):
    inputs = scene(n=60, seed=seed)
    white = {name: torch.ones_like(inputs[name]) for name in ("colors", "backgrounds")}
    assert (rasterization(**{**inputs, **white}).colors - 1).abs().max() < 1e-12
    # Smaller tiles cull more; the pairs that are left are the same.
    small = rasterization(**inputs, settings=RasterSettings(tile_size=4))
    assert torch.equal(small.colors, rasterization(**inputs).colors)


def test_without_perspective_distance_changes_nothing_but_depth():
    inputs = without_perspective(scene(n=40))
    near = rasterization(**inputs)
    further = inputs["viewmats"].clone()
    further[..., 2, 3] += 7.0
    far = rasterization(**{**inputs, "viewmats": further})
    assert relative(far.colors, near.colors) < 1e-12
    seen = near.info["depths"] > 0
    assert torch.allclose(far.info["depths"][seen], near.info["depths"][seen] + 7.0, atol=1e-12)
    assert torch.allclose(far.info["means2d"], near.info["means2d"], atol=1e-12)


def test_orthographic_is_the_limit_of_a_long_lens():
    inputs = scene(n=40, spread=0.15)
    inputs["Ks"][..., [0, 1], [0, 1]] /= 1.2
    parallel = rasterization(**inputs, camera_model="ortho")
    distance = 1e6
    inputs["Ks"][..., [0, 1], [0, 1]] *= distance
    inputs["viewmats"][..., 2, 3] += distance
    assert relative(rasterization(**inputs).colors, parallel.colors) < 1e-4


def test_a_transparent_gaussian_has_no_gradient_on_its_color():
    inputs = scene(n=20)
    inputs["opacities"][3] = 0.0
    _, _, grads = gradients(inputs)
    assert (grads["colors"][3] == 0).all() and (grads["colors"][4] != 0).any()


def test_scaling_a_quaternion_scales_its_gradient_back():
    inputs = scene(n=20)
    _, _, grads = gradients(inputs)
    _, _, scaled = gradients({**inputs, "quats": 3.0 * inputs["quats"]})
    assert relative(scaled["quats"], grads["quats"] / 3.0) < 1e-12
    assert (grads["quats"] * inputs["quats"]).sum(-1).abs().max() < 1e-12


def test_antialiased_dims_what_is_thinner_than_a_pixel():
    inputs = scene(n=20)
    inputs["scales"] *= 1e-2
    plain = rasterization(**inputs).alphas.sum()
    assert rasterization(**inputs, settings=RasterSettings(antialiased=True)).alphas.sum() < 0.2 * plain

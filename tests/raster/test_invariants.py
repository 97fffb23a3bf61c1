"""Two ways to the same picture, for arbitrary scenes: what must be equal to the last bit, and what nearly."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from raster_oracle import footprints
from raster_scenes import DIFFERENTIABLE, gradients, relative, scene
from test_properties import product, rotation

from bigs.raster import RasterSettings, rasterization

MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
OF_GAUSSIANS = ("means", "quats", "scales", "opacities", "colors")

scenes = st.builds(
    scene,
    n=st.integers(1, 90),
    channels=st.integers(1, 5),
    width=st.integers(1, 50),
    height=st.integers(1, 40),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    seed=st.integers(0, 2**31),
    spread=st.sampled_from([0.1, 0.35, 1.0]),
)
doubles = st.builds(
    scene, n=st.integers(1, 60), seed=st.integers(0, 2**31), spread=st.sampled_from([0.1, 0.35])
)
rules = st.builds(
    RasterSettings,
    tile_size=st.sampled_from([4, 8, 16, 32]),
    eps2d=st.sampled_from([0.3, 0.01]),
    alpha_threshold=st.sampled_from([1 / 255, 0.0, 0.05]),
    max_alpha=st.sampled_from([0.999, 0.6]),
    min_transmittance=st.sampled_from([1e-4, 0.0, 0.2]),
    antialiased=st.booleans(),
)
few = settings(max_examples=15, deadline=None)


def same(first, second):
    return all(
        torch.equal(a, b)
        for a, b in zip((*first[:2], *first[2].values()), (*second[:2], *second[2].values()), strict=True)
    )


@few
@given(doubles, st.sampled_from([1e-3, 0.1, 10.0, 1e4]), rules)
def test_units_do_not_matter(inputs, unit, rule):
    """Metres or kilometres: the same image, depths as many times as large, gradients as much smaller."""
    large = {**inputs, "viewmats": inputs["viewmats"].clone()}
    large["viewmats"][:, :3, 3] *= unit
    for name in ("means", "scales"):
        large[name] = inputs[name] * unit
    planes = {"near_plane": 0.01 * unit, "far_plane": 1e10 * unit}
    scaled_rule = RasterSettings(**{**rule.__dict__, **planes})
    still, moved = (
        rasterization(**i, settings=r, render_mode="RGB+D") for i, r in ((inputs, rule), (large, scaled_rule))
    )
    assert relative(moved.colors[..., :-1], still.colors[..., :-1]) < 1e-10
    assert relative(moved.colors[..., -1] / unit, still.colors[..., -1]) < 1e-10
    _, _, grads = gradients(inputs, settings=rule)
    _, _, large_grads = gradients(large, settings=scaled_rule)
    for name in OF_GAUSSIANS:
        factor = unit if name in ("means", "scales") else 1.0
        assert relative(large_grads[name] * factor, grads[name]) < 1e-8


@few
@given(doubles, st.integers(0, 2**31))
def test_gradients_move_with_the_world(inputs, seed):
    q, R = rotation(seed)
    turned = {
        **inputs,
        "means": inputs["means"] @ R.T,
        "quats": product(q, inputs["quats"]),
        "viewmats": inputs["viewmats"].clone(),
    }
    turned["viewmats"][:, :3, :3] = inputs["viewmats"][:, :3, :3] @ R.T
    _, _, grads = gradients(inputs)
    _, _, turned_grads = gradients(turned)
    assert relative(turned_grads["means"], grads["means"] @ R.T) < 1e-8
    assert relative(turned_grads["quats"], product(q, grads["quats"])) < 1e-8
    for name in ("scales", "opacities", "colors", "backgrounds"):
        assert relative(turned_grads[name], grads[name]) < 1e-8


@few
@given(scenes, rules)
def test_tiles_are_invisible(inputs, rule):
    images = [
        gradients(inputs, settings=RasterSettings(**{**rule.__dict__, "tile_size": size}))
        for size in (4, 8, 16, 32)
    ]
    tolerance = 1e-4 if inputs["means"].dtype == torch.float32 else 1e-11
    for colors, alphas, grads in images[1:]:
        assert torch.equal(colors, images[0][0]) and torch.equal(alphas, images[0][1])
        for name in grads:
            assert relative(grads[name], images[0][2][name]) < tolerance


@few
@given(scenes, rules, st.sampled_from(MODES), st.integers(0, 2**31))
def test_a_mask_changes_nothing_where_it_is_open(inputs, rule, mode, seed):
    g = torch.Generator().manual_seed(seed)
    mask = torch.rand(1, inputs["height"], inputs["width"], generator=g) < 0.6
    whole = rasterization(**inputs, settings=rule, render_mode=mode)
    masked = rasterization(**inputs, settings=rule, render_mode=mode, pixel_mask=mask)
    assert torch.equal(masked.colors[mask], whole.colors[mask])
    assert torch.equal(masked.alphas[mask], whole.alphas[mask])
    assert (masked.alphas[~mask] == 0).all()
    if "RGB" in mode:
        behind = inputs["backgrounds"][0].expand(int((~mask).sum()), -1)
        assert torch.equal(masked.colors[~mask][:, : behind.shape[-1]], behind)


@few
@given(st.integers(0, 2**31), st.sampled_from(MODES), st.sampled_from([torch.float32, torch.float64]))
def test_a_batch_is_its_views(seed, mode, dtype):
    inputs = scene(n=70, batch=(2,), cameras=2, width=40, height=30, dtype=dtype, seed=seed)
    colors, alphas, grads = gradients(inputs, render_mode=mode, seed=seed)
    g = torch.Generator().manual_seed(seed)
    v_colors, v_alphas = (
        torch.randn(x.shape, generator=g, dtype=torch.float64).to(dtype) for x in (colors, alphas)
    )
    of_entry = {name: torch.zeros_like(grads[name]) for name in OF_GAUSSIANS}
    for entry in range(2):
        for camera in range(2):
            view = {k: v[entry] if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}
            for name in ("viewmats", "Ks", "backgrounds"):
                view[name] = view[name][camera : camera + 1]
            leaves = {k: view[k].clone().requires_grad_() for k in DIFFERENTIABLE}
            image, alpha, _ = rasterization(**{**view, **leaves}, render_mode=mode)
            assert torch.equal(image[0], colors[entry, camera]) and torch.equal(
                alpha[0], alphas[entry, camera]
            )
            found = torch.autograd.grad(
                [image, alpha],
                list(leaves.values()),
                [v_colors[entry, camera][None], v_alphas[entry, camera][None]],
                allow_unused=True,
                materialize_grads=True,
            )
            for name, v in zip(leaves, found, strict=True):
                if name in of_entry:
                    of_entry[name][entry] += v
                else:
                    assert torch.equal(v[0], grads[name][entry, camera])
    for name in of_entry:
        assert torch.equal(of_entry[name], grads[name])


@few
@given(scenes, rules, st.lists(st.sampled_from(DIFFERENTIABLE), min_size=1, max_size=4, unique=True))
def test_what_nobody_asks_for_changes_nothing(inputs, rule, names):
    colors, alphas, everything = gradients(inputs, settings=rule)
    leaves = {k: inputs[k].clone().requires_grad_() for k in names}
    some = rasterization(**{**inputs, **leaves}, settings=rule)
    g = torch.Generator().manual_seed(0)
    v = [torch.randn(x.shape, generator=g, dtype=torch.float64).to(x.dtype) for x in (colors, alphas)]
    found = torch.autograd.grad(
        [some.colors, some.alphas], list(leaves.values()), v, allow_unused=True, materialize_grads=True
    )
    assert torch.equal(some.colors, colors)
    assert all(torch.equal(v, everything[name]) for name, v in zip(leaves, found, strict=True))


@few
@given(scenes, rules)
def test_who_cannot_be_seen_changes_nothing(inputs, rule):
    n = len(inputs["means"])
    unseen = {**inputs}
    for name in OF_GAUSSIANS:
        unseen[name] = inputs[name].repeat(2, *[1] * (inputs[name].ndim - 1))
    hidden = torch.arange(n, 2 * n)
    unseen["means"][hidden[0::3], 2] = -1.0
    unseen["means"][hidden[1::3], 0] += 1e4
    unseen["opacities"][hidden[2::3]] = -1.0
    given_, more = gradients(inputs, settings=rule), gradients(unseen, settings=rule)
    if rule.alpha_threshold == 0:
        # Then nothing is off screen, only infinitely faint.
        assert relative(more[0], given_[0]) < 1e-6
        return
    assert torch.equal(more[0], given_[0]) and torch.equal(more[1], given_[1])
    assert all(torch.equal(more[2][name][:n], given_[2][name]) for name in OF_GAUSSIANS)
    assert all((more[2][name][n:] == 0).all() for name in OF_GAUSSIANS)


@few
@given(st.integers(0, 2**31), st.integers(1, 25), st.integers(1, 20))
def test_a_window_of_the_image_is_the_image(seed, left, top):
    # The slope that the Jacobian may have depends on the window: everything stays within the smaller one.
    inputs = scene(n=60, width=60, height=48, seed=seed, spread=0.1)
    inputs["Ks"][:, [0, 1], [0, 1]] *= 0.5
    window = {**inputs, "Ks": inputs["Ks"].clone(), "width": 30, "height": 24}
    window["Ks"][:, 0, 2] -= left
    window["Ks"][:, 1, 2] -= top
    big, small = rasterization(**inputs), rasterization(**window)
    x, y = (big.info["means2d"][0] - torch.tensor([left, top])).unbind(-1)
    if ((x < -4) | (x > 34) | (y < -3) | (y > 27)).any():
        return
    assert relative(small.colors, big.colors[:, top : top + 24, left : left + 30]) < 1e-10


@few
@given(st.integers(0, 2**31), st.sampled_from(["RGB", "D", "RGB+D"]))
def test_single_precision_is_within_its_bounds(seed, mode):
    inputs = scene(n=120, width=50, height=40, seed=seed)
    rule = RasterSettings(alpha_threshold=1e-6, min_transmittance=0.0)
    single = {k: v.float() if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}
    double = {k: v.double() if isinstance(v, torch.Tensor) else v for k, v in single.items()}
    exact, rounded = (gradients(i, settings=rule, render_mode=mode) for i in (double, single))
    assert relative(rounded[0], exact[0]) < 2e-6 and relative(rounded[1], exact[1]) < 2e-6
    for name, grad in exact[2].items():
        assert relative(rounded[2][name], grad) < 1e-4


def weights_of(inputs, rule):
    """How much of each Gaussian every pixel has [H, W, N]: in the engine, each has a colour of its own."""
    painted = {
        **inputs,
        "colors": torch.eye(len(inputs["means"]), dtype=inputs["means"].dtype),
        "backgrounds": None,
    }
    return rasterization(**painted, settings=rule).colors[0]


def every_pair(inputs, rule):
    """The same from a loop over every pixel and every Gaussian; and alphas before any threshold."""
    screen = footprints(inputs, rule)
    order = np.argsort(screen.depths.numpy(), kind="stable")
    height, width, n = inputs["height"], inputs["width"], len(inputs["means"])
    weights, raw = np.zeros((height, width, n)), np.zeros((height, width, n))
    centres, whitening = screen.means2d.numpy(), screen.whitening.numpy()
    opacities, ids = screen.opacities.numpy(), screen.ids.numpy()
    for row in range(height):
        for column in range(width):
            light = 1.0
            for k in order:
                dx, dy = column + 0.5 - centres[k, 0], row + 0.5 - centres[k, 1]
                a, b, c = whitening[k]
                alpha = opacities[k] * np.exp(-0.5 * ((a * dx + b * dy) ** 2 + (c * dy) ** 2))
                raw[row, column, ids[k]] = alpha
                alpha = min(alpha, rule.max_alpha)
                if alpha < rule.alpha_threshold:
                    continue
                if light * (1 - alpha) <= rule.min_transmittance:
                    break
                weights[row, column, ids[k]] = alpha * light
                light *= 1 - alpha
    return torch.from_numpy(weights), torch.from_numpy(raw)


@pytest.mark.parametrize("tile_size", [4, 8, 16, 32])
@pytest.mark.parametrize("seed", range(4))
def test_culling_drops_no_pair(seed, tile_size):
    inputs = scene(n=40, width=37, height=29, seed=seed, spread=[0.35, 0.05, 0.8, 0.35][seed])
    if seed == 3:
        inputs["scales"][::2] *= torch.tensor([8.0, 0.01, 0.01])
    rule = RasterSettings(tile_size=tile_size)
    expected, raw = every_pair(inputs, rule)
    weights = weights_of(inputs, rule)
    assert torch.equal(weights > 0, expected > 0) and (expected > 0).sum() > 500
    assert (weights - expected).abs().max() < 1e-13
    # Single precision may take another side only where alpha or the light left stands on the edge.
    single = {k: v.float() if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}
    differ = (weights_of(single, rule) > 0) != (expected > 0)
    edge = (raw * 255 - 1).abs() < 1e-3
    assert not (differ & ~edge).any() or differ.sum() <= 2

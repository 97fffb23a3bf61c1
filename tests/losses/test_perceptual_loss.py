"""The perceptual term against an independent network built of torch's own modules, and its patches."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from small_vgg import LAYERS, WIDTHS, lpips_channels, torchvision_state
from torch import Tensor, nn

from bigs.checks import InputError
from bigs.losses.perceptual import (
    VggWeights,
    draw_patches,
    masked_perceptual,
    perceptual_distance,
    vgg_features,
)
from bigs.losses.perceptual_file import load_perceptual_weights


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("vgg")
    torch.save(torchvision_state(), folder / "vgg16.pth")
    torch.save(lpips_channels(), folder / "lpips.pth")
    return {"vgg": folder / "vgg16.pth", "lpips": folder / "lpips.pth"}


@pytest.fixture(scope="module")
def plain(files: dict[str, Path]) -> VggWeights:
    return load_perceptual_weights([files["vgg"]])


@pytest.fixture(scope="module")
def weighted(files: dict[str, Path]) -> VggWeights:
    return load_perceptual_weights([files["vgg"], files["lpips"]])


def pictures(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def modules() -> nn.Sequential:
    """VGG-16's features as torchvision stacks them, with the small network's weights."""
    layers: list[nn.Module] = []
    before = 3
    for width, last in zip(WIDTHS, (0, 1, 0, 1, 0, 0, 1, 0, 0, 1, 0, 0, 1), strict=True):
        layers += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU()]
        layers += [nn.MaxPool2d(2, 2)] if last else []
        before = width
    network = nn.Sequential(*layers)
    state = torchvision_state()
    network.load_state_dict(
        {f"{i}.{p}": state[f"features.{i}.{p}"] for i in LAYERS for p in ("weight", "bias")}
    )
    return network


def test_features_are_those_of_the_stacked_modules(plain: VggWeights) -> None:
    images = pictures(2, 3, 32, 48)
    x = (images - torch.tensor([0.485, 0.456, 0.406])[:, None, None]) / torch.tensor([0.229, 0.224, 0.225])[
        :, None, None
    ]
    expected = []
    for index, layer in enumerate(modules()):
        x = layer(x)
        if index in (3, 8, 15, 22, 29):  # relu1_2, relu2_2, relu3_3, relu4_3, relu5_3
            expected.append(x)
    found = vgg_features(images, plain)
    assert [f.shape[1:] for f in found] == [(4, 32, 48), (6, 16, 24), (8, 8, 12), (8, 4, 6), (8, 2, 3)]
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b)


def test_distance_by_hand(plain: VggWeights, weighted: VggWeights) -> None:
    a, b = pictures(2, 3, 32, 32), pictures(2, 3, 32, 32, seed=1)
    alike, lpips = 0.0, 0.0
    for block, (fa, fb) in enumerate(zip(vgg_features(a, plain), vgg_features(b, plain), strict=True)):
        # The small number below the root shows where hardly any feature is active.
        na, nb = ((f.square().sum(1, keepdim=True) + 1e-10).sqrt() for f in (fa, fb))
        square = (fa / na - fb / nb) ** 2
        alike += float(square.sum(1).mean())
        lpips += float((square * lpips_channels()[f"lin{block}.model.1.weight"]).sum(1).mean())
    assert perceptual_distance(a, b, plain).item() == pytest.approx(alike, rel=1e-5)
    assert perceptual_distance(a, b, weighted).item() == pytest.approx(lpips, rel=1e-5)
    assert perceptual_distance(a, a, weighted) == 0.0


def test_following_the_gradient_brings_images_together(weighted: VggWeights) -> None:
    target, pred = pictures(1, 3, 16, 16), pictures(1, 3, 16, 16, seed=1).requires_grad_()
    optimizer = torch.optim.Adam([pred], lr=0.02)
    losses = []
    for _ in range(30):
        loss = perceptual_distance(pred, target, weighted)
        losses.append(loss.item())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert losses[-1] < 0.4 * losses[0]


def test_an_image_without_features_has_a_finite_gradient(plain: VggWeights) -> None:
    silent = VggWeights(tuple((kernel, bias - 100.0) for kernel, bias in plain.convolutions))
    pred = torch.zeros(1, 3, 16, 16, requires_grad=True)
    perceptual_distance(pred, pictures(1, 3, 16, 16), silent).backward()
    assert torch.equal(pred.grad, torch.zeros_like(pred))


@pytest.mark.parametrize("size", [(5, 40), (1, 1), (16, 17)])
def test_small_images_are_compared_too(plain: VggWeights, size: tuple[int, int]) -> None:
    a, b = pictures(1, 3, *size), pictures(1, 3, *size, seed=1)
    assert 0.0 < perceptual_distance(a, b, plain).item() < 20.0


# --- patches ---


def test_patches_lie_inside_and_mostly_on_the_mask() -> None:
    mask = torch.zeros(3, 60, 90)
    mask[:, 10:20, 60:70] = 1.0
    generator = torch.Generator().manual_seed(0)
    places = draw_patches(mask, 300, 16, generator)
    assert [index for index, _, _ in places[:4]] == [(places[0][0] + i) % 3 for i in range(4)]
    assert all(0 <= row <= 60 - 16 and 0 <= column <= 90 - 16 for _, row, column in places)
    on_mask = [10 <= row + 8 < 20 and 60 <= column + 8 < 70 for _, row, column in places]
    assert 0.84 < sum(on_mask) / 300 < 0.96
    again = draw_patches(mask, 300, 16, torch.Generator().manual_seed(0))
    assert places == again
    assert places != draw_patches(mask, 300, 16, torch.Generator().manual_seed(1))


def test_an_empty_mask_and_a_small_image_have_patches() -> None:
    generator = torch.Generator().manual_seed(0)
    assert draw_patches(torch.zeros(1, 9, 20), 2, 128, generator) == [(0, 0, 0)] * 2


def test_what_is_outside_the_mask_does_not_count(plain: VggWeights) -> None:
    target, mask = pictures(2, 40, 40, 3), torch.zeros(2, 40, 40)
    mask[:, 10:30, 10:30] = 1.0
    outside = torch.where(mask[..., None] > 0, target, 1.0 - target)

    def loss(pred: Tensor) -> float:
        return masked_perceptual(pred, target, mask, plain, torch.Generator().manual_seed(3), size=24).item()

    assert loss(outside) == 0.0
    assert loss(1.0 - target) > 0.01


def test_the_seed_decides(plain: VggWeights) -> None:
    pred, target, mask = pictures(2, 40, 40, 3), pictures(2, 40, 40, 3, seed=1), torch.ones(2, 40, 40)
    first, again, other = (
        masked_perceptual(pred, target, mask, plain, torch.Generator().manual_seed(seed), size=24)
        for seed in (5, 5, 6)
    )
    assert torch.equal(first, again) and not torch.equal(first, other)


# --- files ---


def assert_equal(a: VggWeights, b: VggWeights) -> None:
    assert len(a.tensors()) == len(b.tensors())
    assert all(torch.equal(x, y) for x, y in zip(a.tensors(), b.tensors(), strict=True))


@pytest.mark.parametrize("layout", ["safetensors", "features alone", "wrapped", "half precision", "slices"])
def test_layouts(plain: VggWeights, weighted: VggWeights, tmp_path: Path, layout: str) -> None:
    state, path = torchvision_state(), tmp_path / "w.pth"
    features = {key.removeprefix("features."): value for key, value in state.items() if "features" in key}
    if layout == "safetensors":
        path = tmp_path / "w.safetensors"
        save_file(state, path)
    elif layout == "features alone":
        torch.save(features, path)
    elif layout == "wrapped":
        torch.save({"state_dict": {f"net.{key}": value for key, value in state.items()}, "epoch": 3}, path)
    elif layout == "half precision":
        torch.save({key: value.half() for key, value in state.items()}, path)
    elif layout == "slices":  # the whole LPIPS module
        ends = (4, 9, 16, 23, 30)
        names = {key: 1 + sum(int(key.split(".")[0]) >= end for end in ends) for key in features}
        sliced = {f"net.slice{names[key]}.{key}": value for key, value in features.items()}
        torch.save({**sliced, **lpips_channels(), "scaling_layer.shift": torch.zeros(3)}, path)
    found = load_perceptual_weights([path])
    if layout == "half precision":
        assert all(value.dtype == torch.float32 for value in found.tensors())
        torch.testing.assert_close(found.convolutions[0][0], plain.convolutions[0][0], atol=2e-3, rtol=1e-3)
    else:
        assert_equal(found, weighted if layout == "slices" else plain)


class Bomb:
    def __reduce__(self):
        return exec, ("raise SystemExit('ran')",)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("missing", "expected a file with VGG-16, found no such file"),
        ("folder", "expected a file with VGG-16, found a folder"),
        ("text", "expected tensors by name .* found data that cannot be read safely"),
        ("empty", "expected tensors by name .* found data that cannot be read safely"),
        ("cut short", "expected tensors by name .* found file is not a zip file"),
        ("code", "expected tensors by name .* found data that cannot be read safely"),
        ("list", "expected tensors by name, found list"),
        ("channels alone", "expected VGG-16 as torchvision names it, found no features.0.weight"),
        ("a layer", "found no features.17.bias"),
        ("shape", r"features.5.weight: expected shape \[any, 4, 3, 3\], found \[6, 5, 3, 3\]"),
        ("nan", r"features.2.bias: expected finite values, found nan at index \[1\]"),
        ("channels", r"lin2.model.1.weight: expected shape \[1, 8, 1, 1\], found \[1, 7, 1, 1\]"),
        ("cut safetensors", "expected tensors by name .* found another file"),
    ],
)
def test_files_that_are_none(files: dict[str, Path], tmp_path: Path, how: str, words: str) -> None:
    state, path = torchvision_state(), tmp_path / "w.pth"
    if how == "folder":
        path.mkdir()
    elif how == "text":
        path.write_text("hello")
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "cut short":
        path.write_bytes(files["vgg"].read_bytes()[:-2000])
    elif how == "code":
        torch.save({**state, "x": Bomb()}, path)
    elif how == "list":
        torch.save([torch.zeros(1)], path)
    elif how == "channels alone":
        torch.save(lpips_channels(), path)
    elif how == "cut safetensors":
        path = tmp_path / "w.safetensors"
        save_file(state, path)
        path.write_bytes(path.read_bytes()[:-10])
    elif how != "missing":
        if how == "a layer":
            del state["features.17.bias"]
        elif how == "shape":
            state["features.5.weight"] = torch.zeros(6, 5, 3, 3)
        elif how == "nan":
            state["features.2.bias"][1] = torch.nan
        elif how == "channels":
            state |= {**lpips_channels(), "lin2.model.1.weight": torch.zeros(1, 7, 1, 1)}
        torch.save(state, path)
    with pytest.raises(InputError, match=words) as caught:
        load_perceptual_weights([path])
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)

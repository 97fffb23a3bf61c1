"""Edges without a network, and PiDiNet against a twin that takes the differences pixel by pixel."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.nn.functional import conv2d, interpolate, max_pool2d, pad

from bigs.checks import InputError
from bigs.guidance.edges import soft_edges
from bigs.guidance.pidinet import load_pidinet

TURNS = ("central", "angular", "radial", "ordinary")


def step_picture(contrast: float, size: int = 64) -> Tensor:
    """Left half dark, right half brighter by `contrast`."""
    picture = torch.full((1, 3, size, size), 0.3)
    picture[..., size // 2 :] += contrast
    return picture


@pytest.mark.parametrize("size", [64, 512])
def test_a_step_is_an_edge_and_a_flat_place_is_none(size: int) -> None:
    edges = soft_edges(step_picture(0.5, size))
    assert edges.shape == (1, 1, size, size)
    assert float(edges[..., size // 2 - 1 : size // 2 + 1].min()) > 0.9
    assert float(edges[..., : size // 4].max()) < 1e-6
    assert float(edges.max()) < 1.0


def test_edges_are_alike_however_strong_but_noise_is_none() -> None:
    middle = slice(31, 33)
    strong, weak = (float(soft_edges(step_picture(c))[..., middle].mean()) for c in (0.6, 0.3))
    assert 0.0 < strong - weak < 0.15
    noise = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    assert float(soft_edges(0.5 + 0.02 * (noise - 0.5)).mean()) < 0.05


def test_one_colour_is_enough_for_an_edge() -> None:
    picture = torch.full((1, 3, 32, 32), 0.5)
    picture[:, 2, :, 16:] = 1.0
    assert float(soft_edges(picture)[..., 15:17].min()) > 0.9


def pidinet_state(width: int, context: int | None, attention: bool) -> dict[str, Tensor]:
    """A network of random weights, by the names that its authors use."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        fan_in = max(1, int(torch.tensor(shape[1:]).prod()))
        return torch.randn(shape, generator=generator) / fan_in**0.5

    state = {"init_block.weight": draw(width, 3, 3, 3)}
    channels = width
    for scale, blocks in enumerate((3, 4, 4, 4)):
        out = (width, 2 * width, 4 * width, 4 * width)[scale]
        for block in range(1, blocks + 1):
            name = f"block{scale + 1}_{block}"
            state |= {
                f"{name}.conv1.weight": draw(channels, 1, 3, 3),
                f"{name}.conv2.weight": draw(out, channels, 1, 1),
            }
            if scale and block == 1:
                state |= {
                    f"{name}.shortcut.weight": draw(out, channels, 1, 1),
                    f"{name}.shortcut.bias": draw(out),
                }
            channels = out
        read = context or channels
        if context:
            name = f"dilations.{scale}"
            state |= {f"{name}.conv1.weight": draw(read, channels, 1, 1), f"{name}.conv1.bias": draw(read)}
            state |= {f"{name}.conv2_{i}.weight": draw(read, read, 3, 3) for i in (1, 2, 3, 4)}
        if attention:
            name = f"attentions.{scale}"
            state |= {f"{name}.conv1.weight": draw(4, read, 1, 1), f"{name}.conv1.bias": draw(4)}
            state[f"{name}.conv2.weight"] = draw(1, 4, 3, 3)
        name = f"conv_reduces.{scale}.conv"
        state |= {f"{name}.weight": draw(1, read, 1, 1), f"{name}.bias": draw(1)}
    return state | {"classifier.weight": draw(1, 4, 1, 1), "classifier.bias": draw(1)}


# Places around a pixel (row, column), clockwise from the upper left corner.
RING = ((-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1))


def by_differences(x: Tensor, kernel: Tensor, kind: str) -> Tensor:
    """A layer as its paper describes it: sum over places of weight times difference of two pixels."""
    if kind == "ordinary":
        return conv2d(x, kernel, padding=1, groups=x.shape[1] // kernel.shape[1])
    height, width = x.shape[-2:]
    around = pad(x, (2, 2, 2, 2))

    def shifted(row: int, column: int) -> Tensor:
        return around[..., 2 + row : 2 + row + height, 2 + column : 2 + column + width]

    total = torch.zeros(len(x), len(kernel), height, width)
    for index, (row, column) in enumerate(RING):
        if kind == "central":
            difference = shifted(row, column) - x
        elif kind == "angular":
            difference = shifted(row, column) - shifted(*RING[(index + 1) % 8])
        else:
            difference = shifted(2 * row, 2 * column) - shifted(row, column)
        weights = kernel[:, :, row + 1, column + 1]
        if kernel.shape[1] == 1:
            total = total + weights[:, 0, None, None] * difference
        else:
            total = total + torch.einsum("oi,bihw->bohw", weights, difference)
    return total


def radial_layout(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The files number a radial kernel's eight directions row by row from the second place on."""
    moved = dict(state)
    for layer, name in enumerate(layer_names()):
        if TURNS[layer % 4] == "radial":
            flat = state[name].flatten(2)
            rows = [4 + 3 * row + column for row, column in sorted(RING)]
            stored = torch.zeros_like(flat)
            stored[..., 1:] = flat[..., rows]
            moved[name] = stored.unflatten(2, (3, 3))
    return moved


def layer_names() -> list[str]:
    blocks = [(scale, block) for scale, count in enumerate((3, 4, 4, 4)) for block in range(1, count + 1)]
    return ["init_block.weight", *(f"block{scale + 1}_{block}.conv1.weight" for scale, block in blocks)]


def twin(images: Tensor, state: dict[str, Tensor], context: bool, attention: bool) -> Tensor:
    """PiDiNet step by step."""
    names = iter(enumerate(layer_names()))

    def differences(x: Tensor) -> Tensor:
        layer, name = next(names)
        return by_differences(x, state[name], TURNS[layer % 4])

    x = differences(images[:, [2, 1, 0]])
    maps = []
    for scale, count in enumerate((3, 4, 4, 4)):
        for block in range(1, count + 1):
            name = f"block{scale + 1}_{block}"
            skipped = x
            if scale and block == 1:
                x = max_pool2d(x, 2)
                skipped = conv2d(x, state[f"{name}.shortcut.weight"], state[f"{name}.shortcut.bias"])
            x = conv2d(differences(x).relu(), state[f"{name}.conv2.weight"]) + skipped
        read = x
        if context:
            at = f"dilations.{scale}"
            read = conv2d(read.relu(), state[f"{at}.conv1.weight"], state[f"{at}.conv1.bias"])
            read = sum(
                conv2d(read, state[f"{at}.conv2_{i}.weight"], padding=d, dilation=d)
                for i, d in ((1, 5), (2, 7), (3, 9), (4, 11))
            )
        if attention:
            at = f"attentions.{scale}"
            inner = conv2d(read.relu(), state[f"{at}.conv1.weight"], state[f"{at}.conv1.bias"])
            read = read * conv2d(inner, state[f"{at}.conv2.weight"], padding=1).sigmoid()
        at = f"conv_reduces.{scale}.conv"
        single = conv2d(read, state[f"{at}.weight"], state[f"{at}.bias"])
        maps.append(interpolate(single, images.shape[-2:], mode="bilinear", align_corners=False))
    joined = conv2d(torch.cat(maps, 1), state["classifier.weight"], state["classifier.bias"])
    return joined.sigmoid()


def saved_pth(path: Path, state: dict[str, Tensor]) -> Path:
    """As the authors save it: from a network on several GPUs, within a checkpoint."""
    torch.save({"epoch": 13, "state_dict": {f"module.{key}": value for key, value in state.items()}}, path)
    return path


def saved_safetensors(path: Path, state: dict[str, Tensor]) -> Path:
    path = path.with_suffix(".safetensors")
    save_file(state, path)
    return path


@pytest.mark.parametrize(
    ("width", "context", "attention", "save"),
    [
        (8, 4, True, saved_pth),
        (6, None, False, saved_safetensors),
        (6, 3, False, saved_pth),
        (6, None, True, saved_pth),
    ],
)
def test_pidinet_agrees_with_its_twin(
    tmp_path: Path, width: int, context: int | None, attention: bool, save: Callable[..., Path]
) -> None:
    state = pidinet_state(width, context, attention)
    network = load_pidinet(save(tmp_path / "network.pth", radial_layout(state)))
    images = torch.rand(2, 3, 37, 50, generator=torch.Generator().manual_seed(1))
    found = network(images)
    assert found.shape == (2, 1, 37, 50)
    assert float(found.std()) > 1e-3
    torch.testing.assert_close(
        found, twin(images, state, context is not None, attention), rtol=1e-4, atol=1e-5
    )


def test_the_published_width_has_the_published_number_of_weights() -> None:
    """710 thousand, as the paper's table says."""
    state = pidinet_state(60, 24, True)
    assert sum(value.numel() for value in state.values()) == pytest.approx(710_000, rel=0.01)


def test_a_converted_file_is_the_same_network(tmp_path: Path) -> None:
    state = pidinet_state(6, 4, True)
    network = load_pidinet(saved_pth(tmp_path / "network.pth", state))
    again = load_pidinet(saved_pth(tmp_path / "converted.pth", network.weights))
    images = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    assert torch.equal(again(images), network(images))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda state: state.pop("block3_2.conv1.weight"), ["expected PiDiNet", "no block3_2.conv1.weight"]),
        (lambda state: state.pop("dilations.1.conv2_3.weight"), ["no dilations.1.conv2_3.weight"]),
        (lambda state: state.update({"classifier.bias": torch.zeros(2)}), ["classifier.bias", "[1]", "[2]"]),
        (lambda state: state["init_block.weight"].fill_(float("nan")), ["init_block.weight", "finite"]),
    ],
)
def test_files_of_other_networks_are_refused(
    tmp_path: Path, damage: Callable[[dict[str, Tensor]], object], words: list[str]
) -> None:
    state = pidinet_state(6, 4, True)
    damage(state)
    path = saved_pth(tmp_path / "network.pth", state)
    with pytest.raises(InputError) as refusal:
        load_pidinet(path)
    assert str(path) in str(refusal.value)
    assert all(word in str(refusal.value) for word in words)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.pth: expected a file with PiDiNet"):
        load_pidinet(tmp_path / "nowhere.pth")

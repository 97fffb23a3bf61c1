"""Textual inversion: only the word is learned, it is learned, and what is hidden is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_diffusion import SIZE
from torch import Tensor

from bigs.checks import InputError
from bigs.guidance.crops import Crop, draw_pictures
from bigs.guidance.diffusers import encode_text, predict_noise
from bigs.guidance.diffusers_folder import Parts, load_parts
from bigs.guidance.edges import soft_edges
from bigs.guidance.inversion import Inversion, InversionConfig
from bigs.guidance.token_file import add_token

CONFIG = InversionConfig("mug", token="<it>", batch=2, lr=0.05)


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def crops(hole: bool = False) -> list[Crop]:
    """One object of noise; with a hole, half of it hidden."""
    picture = torch.randint(0, 255, (3, 48, 48), generator=seeded(4), dtype=torch.uint8)
    mask = torch.zeros(1, 48, 48, dtype=torch.uint8)
    mask[:, 9 : 24 if hole else 39, 9:39] = 255
    return [Crop(torch.where(mask > 0, picture, 255), mask)]


@pytest.fixture
def parts(tiny_model: Path, tiny_controlnet: Path) -> Parts:
    """The tiny model with its ControlNet."""
    return load_parts(str(tiny_model), controlnet=str(tiny_controlnet), device="cpu")


def weights_of(parts: Parts) -> dict[str, Tensor]:
    return {
        f"{index}.{name}": value.clone()
        for index, network in enumerate(parts.networks)
        for name, value in network.state_dict().items()
    }


def test_the_word_starts_as_the_mean_of_the_objects_name(parts: Parts) -> None:
    ids = parts.tokenizer("mug", add_special_tokens=False).input_ids
    rows = parts.text_encoder.get_input_embeddings().weight[ids]
    torch.testing.assert_close(Inversion(parts, CONFIG).embedding[0].detach(), rows.mean(0))


def test_nothing_but_the_word_changes(parts: Parts) -> None:
    inversion = Inversion(parts, CONFIG)
    start, before = inversion.token.embedding, weights_of(parts)
    for _ in range(3):
        inversion.take_step(crops(), soft_edges)
    after = weights_of(parts)
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert not torch.allclose(inversion.token.embedding, start, atol=1e-2)
    assert inversion.step == 3


def test_the_gradient_is_that_of_the_words_row_in_the_table(parts: Parts, tiny_model: Path) -> None:
    inversion = Inversion(parts, CONFIG)
    inversion.loss(crops(), soft_edges, seeded(0)).backward()
    # The same loss with the word written into the table, and the whole table differentiated.
    twin = load_parts(str(tiny_model), device="cpu")
    twin = Parts(**{**vars(twin), "controlnet": parts.controlnet})
    other = Inversion(twin, CONFIG)
    table = twin.text_encoder.get_input_embeddings()
    table._forward_hooks.clear()
    with torch.no_grad():
        table.weight[-1] = inversion.embedding[0]
    table.weight.requires_grad_()
    other.loss(crops(), soft_edges, seeded(0)).backward()
    assert inversion.embedding.grad is not None
    assert float(inversion.embedding.grad.abs().max()) > 0
    torch.testing.assert_close(inversion.embedding.grad[0], table.weight.grad[-1], rtol=1e-4, atol=1e-7)


def test_a_word_that_the_model_knows_is_found_again(parts: Parts, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the noise to be estimated is what the network says of a known word, learning leads there."""
    parts = Parts(**{**vars(parts), "controlnet": None})
    # Pure noise at every timestep, so that z_t tells the noise.
    parts.scheduler.alphas_cumprod = torch.zeros(1000)
    with torch.no_grad():
        known = encode_text(parts, ["a photo of a q mug"] * 2)

    def estimate(parts: Parts, noisy: Tensor, timesteps: Tensor, *, texts: Tensor, control: None) -> Tensor:
        ours, theirs = (
            predict_noise(parts, noisy, timesteps, texts=t, control=control) for t in (texts, known)
        )
        return noisy + ours - theirs

    monkeypatch.setattr("bigs.guidance.inversion.predict_noise", estimate)
    monkeypatch.setattr("bigs.guidance.inversion.TEMPLATES", ("a photo of a {}",))
    inversion = Inversion(parts, CONFIG)
    losses = [inversion.take_step(crops(), soft_edges) for _ in range(40)]
    assert sum(losses[-5:]) < 0.1 * sum(losses[:5])


def test_only_places_on_the_object_count(parts: Parts, monkeypatch: pytest.MonkeyPatch) -> None:
    estimates = []

    def estimate(_parts: Parts, noisy: Tensor, *_: Any, **__: Any) -> Tensor:
        estimates.append(torch.zeros_like(noisy).requires_grad_())
        return estimates[-1]

    monkeypatch.setattr("bigs.guidance.inversion.predict_noise", estimate)
    Inversion(parts, CONFIG).loss(crops(hole=True), soft_edges, seeded(1)).backward()
    _, shares = draw_pictures(crops(hole=True), CONFIG.batch, SIZE, seeded(1))
    on_object = torch.nn.functional.avg_pool2d(shares, 2)
    gradient = estimates[0].grad
    assert gradient is not None
    counts = gradient.abs().amax(1, keepdim=True)
    assert 0.1 < float((on_object > 0).float().mean()) < 0.5
    assert torch.equal(counts > 0, on_object > 0)


def test_the_controlnet_takes_part(parts: Parts) -> None:
    inversion = Inversion(parts, CONFIG)
    with torch.no_grad():
        losses = {
            float(inversion.loss(crops(), edges, seeded(1)))
            for edges in (soft_edges, lambda images: torch.zeros_like(images[:, :1]))
        }
        inversion._parts = Parts(**{**vars(parts), "controlnet": None})
        losses.add(float(inversion.loss(crops(), soft_edges, seeded(1))))
    assert len(losses) == 3


def test_a_restored_word_goes_on_to_the_same_bits(parts: Parts, tiny_model: Path) -> None:
    alone = Parts(**{**vars(parts), "controlnet": None})
    whole = Inversion(alone, CONFIG)
    for _ in range(4):
        whole.take_step(crops(), soft_edges)
    first = Inversion(load_parts(str(tiny_model), device="cpu"), CONFIG)
    for _ in range(2):
        first.take_step(crops(), soft_edges)
    second = Inversion(load_parts(str(tiny_model), device="cpu"), CONFIG)
    second.restore(first.state(), first.step)
    for _ in range(2):
        second.take_step(crops(), soft_edges)
    assert second.step == 4
    assert torch.equal(second.token.embedding, whole.token.embedding)


def test_the_learned_word_means_to_others_what_it_meant_in_training(parts: Parts, tiny_model: Path) -> None:
    inversion = Inversion(parts, CONFIG)
    inversion.take_step(crops(), soft_edges)
    other = load_parts(str(tiny_model), device="cpu")
    word = add_token(other, inversion.token)
    prompt = f"a photo of a {word} mug"
    with torch.no_grad():
        torch.testing.assert_close(encode_text(other, [prompt]), encode_text(parts, [prompt]))


def test_a_gradient_that_is_not_finite_stops_the_work(parts: Parts, monkeypatch: pytest.MonkeyPatch) -> None:
    inversion = Inversion(parts, CONFIG)
    before = inversion.token.embedding
    real = inversion.loss
    monkeypatch.setattr(inversion, "loss", lambda *a: real(*a) * float("inf"))
    with pytest.raises(FloatingPointError, match="step 0: the gradient of <it>"):
        inversion.take_step(crops(), soft_edges)
    assert torch.equal(inversion.token.embedding, before)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"object_name": ""}, "object name: expected at least one word"),
        ({"token": "two words"}, "token: expected one word .* 'two words'"),
        ({"steps": 0}, "steps: expected at least 1, found 0"),
        ({"batch": 0}, "batch: expected at least 1, found 0"),
        ({"conditioning_scale": -0.1}, "conditioning_scale: expected 0 or more, found -0.1"),
        ({"lr": 0.0}, "lr: expected more than 0, found 0.0"),
    ],
)
def test_settings_that_cannot_be(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        InversionConfig(**{"object_name": "mug", **settings})


@pytest.mark.parametrize("token", ["<Mug>", "mein-Becher", "käfer", "sks1"])
def test_words_of_any_spelling_stay_whole(parts: Parts, token: str) -> None:
    Inversion(parts, replace(CONFIG, token=token))
    plain, asked = (parts.tokenizer(f"a photo of a {word} mug").input_ids for word in ("", token))
    assert len(asked) == len(plain) + 1


def test_pictures_have_the_models_size(parts: Parts) -> None:
    seen = []
    Inversion(parts, CONFIG).loss(
        crops(), lambda images: seen.append(images) or soft_edges(images), seeded(0)
    )
    assert seen[0].shape == (2, 3, SIZE, SIZE)

"""The adapter over Stable Diffusion, run on a tiny random model through the real loading code."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from tiny_diffusion import SIZE, as_pipeline, write_model
from torch import Tensor

from bigs.checks import InputError
from bigs.guidance import Conditions, SdsConfig, sds_loss, timestep_weight
from bigs.guidance.diffusers import (
    DiffusionConfig,
    StableDiffusion,
    encode_images,
    encode_text,
    load_stable_diffusion,
    predict_noise,
)
from bigs.guidance.diffusers_folder import Parts, load_parts
from bigs.guidance.edges import soft_edges
from bigs.guidance.prompts import VIEWS, PromptConfig, view_indices, view_prompts
from bigs.guidance.token_file import Token, add_token, read_token, write_token

PROMPTS = PromptConfig("mug", "a {object}", "bad")
FRONT, BACK = 0.0, math.pi


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def doubled(parts: Parts) -> Parts:
    """All networks in float64."""
    for network in parts.networks:
        network.double()
    return parts


@pytest.fixture
def parts(tiny_model: Path) -> Parts:
    """The tiny model in float64."""
    return doubled(load_parts(str(tiny_model), device="cpu"))


@pytest.fixture
def controlled(tiny_model: Path, tiny_controlnet: Path) -> Parts:
    """The tiny model with its ControlNet, in float64."""
    return doubled(load_parts(str(tiny_model), controlnet=str(tiny_controlnet), device="cpu"))


def pictures(count: int = 1) -> Tensor:
    return torch.rand(count, 3, SIZE, SIZE, generator=seeded(3), dtype=torch.float64)


def random_latents(count: int, seed: int = 0) -> Tensor:
    return torch.randn(count, 4, 16, 16, generator=seeded(seed), dtype=torch.float64)


def conditions(*azimuths: float, elevation: float = 0.0) -> Conditions:
    return Conditions(torch.tensor(azimuths), torch.full((len(azimuths),), elevation))


@pytest.mark.parametrize("scale", [0.0, 1.0, 50.0])
def test_guidance_mixes_two_runs_of_the_network(parts: Parts, scale: float) -> None:
    prior = StableDiffusion(parts, PROMPTS, guidance_scale=scale)
    noisy, timesteps = (
        torch.randn(2, 4, 16, 16, generator=seeded(), dtype=torch.float64),
        torch.tensor([3, 700]),
    )
    found = prior.predict(noisy, timesteps, conditions(FRONT, BACK))

    def network(texts: list[str]) -> Tensor:
        with torch.no_grad():
            encoded = encode_text(parts, texts)
            return parts.unet(noisy, timesteps, encoder_hidden_states=encoded, return_dict=False)[0]

    without, asked = network(["bad", "bad"]), network(["a mug, front view", "a mug, back view"])
    assert not torch.allclose(without, asked, rtol=1e-4)
    torch.testing.assert_close(found, without + scale * (asked - without), rtol=1e-9, atol=1e-9)


def test_the_controlnet_sees_the_edges_and_its_scale_counts(controlled: Parts) -> None:
    noisy, timesteps = random_latents(1), torch.tensor([400])
    edges = soft_edges(pictures())

    def estimate(scale: float, edges: Tensor) -> Tensor:
        prior = StableDiffusion(controlled, PROMPTS, guidance_scale=3.0, conditioning_scale=scale)
        return prior.predict(noisy, timesteps, conditions(FRONT)._replace(edges=edges))

    plain, weak, strong = (estimate(scale, edges) for scale in (0.0, 0.3, 1.0))
    assert not torch.allclose(strong, plain, rtol=1e-3)
    assert not torch.allclose(strong, weak, rtol=1e-3)
    assert not torch.allclose(strong, estimate(1.0, torch.zeros_like(edges)), rtol=1e-3)
    without = StableDiffusion(Parts(**{**vars(controlled), "controlnet": None}), PROMPTS, guidance_scale=3.0)
    torch.testing.assert_close(plain, without.predict(noisy, timesteps, conditions(FRONT)))
    assert without.detect_edges is None
    with pytest.raises(InputError, match="expected edges"):
        StableDiffusion(controlled, PROMPTS).predict(noisy, timesteps, conditions(FRONT))


def test_the_librarys_own_pipeline_takes_the_same_step(controlled: Parts) -> None:
    """Prompts, guidance and ControlNet together, against code that is not ours."""
    from diffusers import StableDiffusionControlNetPipeline

    pipeline = StableDiffusionControlNetPipeline(
        **vars(controlled), safety_checker=None, feature_extractor=None, requires_safety_checker=False
    )
    pipeline.set_progress_bar_config(disable=True)
    noisy, edges = random_latents(1), soft_edges(pictures())
    taken: dict[str, Tensor] = {}

    def keep(_pipeline: Any, _step: int, timestep: Tensor, values: dict[str, Tensor]) -> dict[str, Tensor]:
        taken.update(timestep=timestep, latents=values["latents"])
        return values

    pipeline(
        "a mug, side view",
        image=edges.expand(-1, 3, -1, -1),
        negative_prompt="bad",
        num_inference_steps=1,
        guidance_scale=7.5,
        controlnet_conditioning_scale=0.7,
        latents=noisy,
        output_type="latent",
        callback_on_step_end=keep,
    )
    prior = StableDiffusion(controlled, PROMPTS, guidance_scale=7.5, conditioning_scale=0.7)
    asked = conditions(math.pi / 2)._replace(edges=edges)
    noise = prior.predict(noisy, taken["timestep"][None], asked)
    ours = controlled.scheduler.step(noise, taken["timestep"], noisy).prev_sample
    torch.testing.assert_close(ours, taken["latents"], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kind", ["epsilon", "v_prediction", "sample"])
def test_every_kind_of_network_gives_the_noise(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A network that predicts its own kind of target perfectly must give back the noise."""
    parts = doubled(load_parts(str(write_model(tmp_path / "model", prediction=kind)), device="cpu"))
    clean, noise = (random_latents(2, seed) for seed in (1, 2))
    timesteps = torch.tensor([10, 900])
    noisy = parts.scheduler.add_noise(clean, noise, timesteps)
    target = {
        "epsilon": noise,
        "v_prediction": parts.scheduler.get_velocity(clean, noise, timesteps),
        "sample": clean,
    }[kind]
    monkeypatch.setattr(parts.unet, "forward", lambda *_, **__: (target,))
    found = predict_noise(parts, noisy, timesteps, texts=torch.zeros(2, 77, 16, dtype=torch.float64))
    torch.testing.assert_close(found, noise, rtol=1e-5, atol=1e-5)


def test_gradient_at_the_picture_is_the_formula_times_the_encoders_jacobian(controlled: Parts) -> None:
    """Eq. 7 through the real encoder, ControlNet and guidance, in float64."""
    prior = StableDiffusion(controlled, PROMPTS, guidance_scale=7.0)
    images = pictures().requires_grad_()
    seen: dict[str, Any] = {}
    original = prior.predict

    def predict(noisy: Tensor, timesteps: Tensor, asked: Conditions) -> Tensor:
        seen.update(noisy=noisy, timesteps=timesteps, estimate=original(noisy, timesteps, asked), asked=asked)
        return seen["estimate"]

    prior.predict = predict
    sds_loss(prior, images, conditions(FRONT), SdsConfig(), progress=0.2, generator=seeded()).backward()
    torch.testing.assert_close(seen["asked"].edges, soft_edges(images.detach()))

    latents = encode_images(controlled, images.detach())
    alphas = prior.alphas_cumprod.double()
    a = alphas[seen["timesteps"]].reshape(1, 1, 1, 1)
    noise = (seen["noisy"] - a.sqrt() * latents) / (1 - a).sqrt()
    assert abs(float(noise.std()) - 1.0) < 0.1
    weight = timestep_weight("sigma2", alphas, seen["timesteps"])
    at_latents = weight * (seen["estimate"] - noise)
    jacobian = torch.autograd.functional.jacobian(
        lambda x: encode_images(controlled, x), images.detach(), vectorize=True
    )
    expected = torch.einsum("bchw,bchwnijk->nijk", at_latents, jacobian)
    torch.testing.assert_close(images.grad, expected, rtol=1e-6, atol=1e-9)
    assert float(expected.abs().max()) > 1e-3


def test_float32_agrees_with_float64(tiny_model: Path, parts: Parts) -> None:
    gradients = []
    for single in (True, False):
        chosen = load_parts(str(tiny_model), device="cpu") if single else parts
        images = pictures().to(torch.float32 if single else torch.float64).requires_grad_()
        prior = StableDiffusion(chosen, PROMPTS)
        sds_loss(prior, images, conditions(BACK), SdsConfig(), progress=0.0, generator=seeded()).backward()
        gradients.append(images.grad.double())
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-4 * float(gradients[1].abs().max()))


def test_latents_are_scaled_and_nothing_is_drawn(parts: Parts) -> None:
    images = pictures(2)
    first, again = encode_images(parts, images), encode_images(parts, images)
    assert first.shape == (2, 4, 16, 16)
    assert torch.equal(first, again)
    mean = parts.vae.encode(2 * images - 1).latent_dist.mean
    torch.testing.assert_close(first, 0.18215 * mean)


def test_views_by_angle() -> None:
    degrees = torch.tensor([0.0, 44, 46, -44, -46, 134, 136, -136, 180, -180, 360, 400, 90, 180, 0])
    elevation = torch.tensor([0.0] * 12 + [61, 61, -61])
    found = view_indices(torch.deg2rad(degrees), torch.deg2rad(elevation))
    expected = "front front side front side side back back back back front front overhead overhead bottom"
    assert [VIEWS[index] for index in found] == expected.split()


def test_prompts_by_view() -> None:
    assert view_prompts(PromptConfig("toy car", "photo of a {object}, sharp"), "<it>") == tuple(
        f"photo of a <it> toy car, sharp, {view} view" for view in VIEWS
    )
    still = PromptConfig("toy car", "photo of a {object}", view_dependent=False)
    assert set(view_prompts(still)) == {"photo of a toy car"}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"prompt": "a mug"}, "prompt: .*{object}.*'a mug'"),
        ({"object_name": " "}, "object name: .* one word"),
    ],
)
def test_prompts_that_cannot_be(settings: dict[str, str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        PromptConfig(**settings)


def test_a_prompt_that_is_too_long_is_refused_not_cut(parts: Parts) -> None:
    with pytest.raises(InputError, match=r"prompt: expected at most 77 .* found 102"):
        encode_text(parts, ["fine", "x" * 100])


def test_the_token_is_in_the_prompts_of_the_unet_but_not_of_the_controlnet(controlled: Parts) -> None:
    token = Token("<it>", torch.full((1, 16), 0.5))
    plain = encode_text(controlled, view_prompts(PROMPTS))
    prior = StableDiffusion(controlled, PROMPTS, token=token)
    texts: dict[str, Tensor] = {}
    for name in ("unet", "controlnet"):
        network = getattr(controlled, name)
        network.register_forward_pre_hook(
            lambda _m, _a, kwargs, name=name: texts.update({name: kwargs["encoder_hidden_states"]}),
            with_kwargs=True,
        )
    edges = torch.zeros(1, 1, SIZE, SIZE, dtype=torch.float64)
    prior.predict(
        torch.zeros(1, 4, 16, 16, dtype=torch.float64),
        torch.tensor([5]),
        conditions(BACK)._replace(edges=edges),
    )
    with_token = encode_text(controlled, ["a <it> mug, back view"])[0]
    torch.testing.assert_close(texts["unet"][1], with_token)
    torch.testing.assert_close(texts["controlnet"][1], plain[VIEWS.index("back")])
    assert not torch.allclose(with_token, plain[VIEWS.index("back")])


def test_tokens_survive_the_file_and_reach_the_text_encoder(parts: Parts, tmp_path: Path) -> None:
    path = tmp_path / "token.safetensors"
    write_token(path, Token("<it>", torch.arange(32.0).reshape(2, 16)))
    token = read_token(path)
    assert add_token(parts, token) == "<it> <it>_1"
    rows = parts.tokenizer("<it> <it>_1", add_special_tokens=False).input_ids
    assert len(rows) == 2
    assert parts.text_encoder.get_input_embeddings().weight[rows].flatten().tolist() == list(range(32))


def test_the_library_reads_our_token_file(tiny_model: Path, tmp_path: Path) -> None:
    write_token(tmp_path / "token.safetensors", Token("<it>", torch.arange(32.0).reshape(2, 16)))
    pipeline = as_pipeline(load_parts(str(tiny_model), device="cpu"))
    pipeline.load_textual_inversion(str(tmp_path / "token.safetensors"))
    words = pipeline.maybe_convert_prompt("<it>", pipeline.tokenizer)
    rows = pipeline.tokenizer(words, add_special_tokens=False).input_ids
    weights = pipeline.text_encoder.get_input_embeddings().weight
    assert weights[rows].flatten().tolist() == list(range(32))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"<a>": torch.zeros(16), "<b>": torch.zeros(16)}, "expected one learned token, found 2"),
        ({"<a>": torch.zeros(1, 2, 8)}, r"<a>: expected shape \[width\], found \[1, 2, 8\]"),
        ({"<a>": torch.full((16,), float("inf"))}, "<a>: expected finite"),
        ({"<a>": torch.zeros(17)}, "token <a>: .* width 16 .* found 17"),
        ({"a</w>": torch.zeros(16)}, "token a</w>: expected a word that is new"),
    ],
)
def test_tokens_that_do_not_fit(
    tiny_model: Path, tmp_path: Path, content: dict[str, Tensor], words: str
) -> None:
    path = tmp_path / "token.safetensors"
    save_file(content, path)
    with pytest.raises(InputError, match=words):
        load_stable_diffusion(DiffusionConfig(str(tiny_model), token=path, device="cpu"))


def test_a_configuration_becomes_a_prior(
    tiny_model: Path, tiny_controlnet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_token(tmp_path / "token.safetensors", Token("<it>", torch.ones(1, 16)))
    config = DiffusionConfig(
        str(tiny_model),
        controlnet=str(tiny_controlnet),
        token=tmp_path / "token.safetensors",
        prompts=PROMPTS,
        guidance_scale=2.0,
        device="cpu",
        attention_slicing=True,
    )
    prior = load_stable_diffusion(config)
    assert prior.image_size == SIZE
    assert prior.detect_edges is not None
    assert torch.equal(prior.detect_edges(pictures()), soft_edges(pictures()))
    images = torch.rand(1, 3, 48, 48, generator=seeded()).requires_grad_()
    sds_loss(prior, images, conditions(FRONT), SdsConfig(), progress=0.5, generator=seeded()).backward()
    assert images.grad is not None
    assert bool(torch.isfinite(images.grad).all())
    assert float(images.grad.abs().max()) > 0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"edge_weights": Path("x.pth")}, "edge_weights: expected a controlnet"),
        ({"conditioning_scale": -1.0}, "conditioning_scale: expected 0 or more, found -1"),
    ],
)
def test_configurations_that_cannot_be(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        DiffusionConfig("model", **settings)

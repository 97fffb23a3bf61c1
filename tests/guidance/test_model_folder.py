"""Model folders as diffusers writes them, and what is said of those that lack something."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_diffusion import SIZE

from bigs.checks import InputError
from bigs.guidance import diffusers_folder
from bigs.guidance.diffusers_folder import COMPONENTS, choose, load_parts


@pytest.fixture
def copy(tiny_model: Path, tmp_path: Path) -> Path:
    """A model folder to damage."""
    return shutil.copytree(tiny_model, tmp_path / "model")


def change(file: Path, **values: Any) -> None:
    """Set entries of a JSON file."""
    file.write_text(json.dumps(json.loads(file.read_text()) | values))


def weights_file(folder: Path) -> Path:
    (file,) = folder.glob("*.safetensors")
    return file


def change_weights(folder: Path, how: Callable[[dict[str, torch.Tensor]], dict[str, torch.Tensor]]) -> None:
    save_file(how(load_file(weights_file(folder))), weights_file(folder), {"format": "pt"})


def test_parts_are_frozen_on_the_cpu_in_float32(tiny_model: Path, tiny_controlnet: Path) -> None:
    parts = load_parts(str(tiny_model), controlnet=str(tiny_controlnet), device="cpu")
    assert parts.image_size == SIZE
    assert len(parts.networks) == 4
    for network in parts.networks:
        assert not network.training
        assert all(p.dtype == torch.float32 and not p.requires_grad for p in network.parameters())
    for name, network in (("unet", parts.unet), ("vae", parts.vae), ("text_encoder", parts.text_encoder)):
        stored = load_file(weights_file(tiny_model / name))
        assert all(torch.equal(network.state_dict()[key], value) for key, value in stored.items())


def test_precision_is_that_of_all_but_the_vae(tiny_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(torch.cuda, "is_available", lambda: True)
        choices = [choose(*asked) for asked in (("auto", "auto"), ("cuda", "bfloat16"), ("cpu", "auto"))]
    assert choices == [
        (torch.device("cuda"), torch.float16),
        (torch.device("cuda"), torch.bfloat16),
        (torch.device("cpu"), torch.float32),
    ]
    monkeypatch.setattr(diffusers_folder, "choose", lambda *_: (torch.device("cpu"), torch.bfloat16))
    parts = load_parts(str(tiny_model))
    assert parts.unet.dtype == parts.text_encoder.dtype == torch.bfloat16
    assert parts.vae.dtype == torch.float32


def test_attention_slicing_changes_the_attention_and_nothing_else(tiny_model: Path) -> None:
    outputs, processors = [], []
    for slicing in (False, True):
        parts = load_parts(str(tiny_model), device="cpu", attention_slicing=slicing)
        processors.append({type(p).__name__ for p in parts.unet.attn_processors.values()})
        inputs = torch.ones(1, 4, 16, 16), torch.tensor([5]), torch.ones(1, 77, 16)
        with torch.no_grad():
            outputs.append(parts.unet(*inputs, return_dict=False)[0])
    assert processors[1] == {"SlicedAttnProcessor"} != processors[0]
    torch.testing.assert_close(*outputs)


def test_names_of_older_text_encoders_are_understood(copy: Path, tiny_model: Path) -> None:
    change_weights(
        copy / "text_encoder",
        lambda weights: {
            **{f"text_model.{name}": value for name, value in weights.items()},
            "text_model.embeddings.position_ids": torch.arange(77)[None],
        },
    )
    old, new = (
        load_parts(str(folder), device="cpu").text_encoder.state_dict() for folder in (copy, tiny_model)
    )
    assert all(torch.equal(old[name], value) for name, value in new.items())


@pytest.mark.parametrize("kept", [["tokenizer.json"], ["vocab.json", "merges.txt"]])
def test_tokenizers_of_either_layout_split_alike(copy: Path, tiny_model: Path, kept: list[str]) -> None:
    for name in {"tokenizer.json", "vocab.json", "merges.txt"} - set(kept):
        (copy / "tokenizer" / name).unlink()
    found, expected = (load_parts(str(folder), device="cpu").tokenizer for folder in (copy, tiny_model))
    assert found("A photo, of 1 mug!").input_ids == expected("A photo, of 1 mug!").input_ids
    assert found.model_max_length == expected.model_max_length == 77


@pytest.mark.parametrize("name", [*COMPONENTS])
@pytest.mark.parametrize("how", ["folder", "file"])
def test_a_missing_component_is_named(copy: Path, name: str, how: str) -> None:
    if how == "folder":
        shutil.rmtree(copy / name)
    else:
        for file in COMPONENTS[name][1]:
            (copy / name / file).unlink(missing_ok=True)
    with pytest.raises(InputError, match=rf"model: expected Stable Diffusion .* found no component {name} "):
        load_parts(str(copy), device="cpu")


def empty(file: Path) -> None:
    file.write_bytes(b"")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda m: weights_file(m / "unet").unlink(), ["component unet", "safetensors"]),
        (lambda m: weights_file(m / "text_encoder").unlink(), ["component text_encoder", "safetensors"]),
        (lambda m: empty(weights_file(m / "vae")), ["component vae"]),
        (lambda m: empty(weights_file(m / "text_encoder")), ["component text_encoder"]),
        (lambda m: empty(m / "unet" / "config.json"), ["component unet", "config.json"]),
        (lambda m: empty(m / "tokenizer" / "tokenizer.json"), ["component tokenizer"]),
        (
            lambda m: change_weights(m / "unet", lambda w: {k: w[k] for k in w if k != "conv_in.bias"}),
            ["all weights", "component unet", "conv_in.bias", "1 are missing"],
        ),
        (
            lambda m: change_weights(m / "text_encoder", lambda w: {k: w[k] for k in w if "final" not in k}),
            ["all weights", "component text_encoder", "final_layer_norm.bias", "2 are missing"],
        ),
        (
            lambda m: change_weights(m / "unet", lambda w: w | {"conv_in.bias": torch.zeros(3)}),
            ["component unet", "conv_in"],
        ),
        (
            lambda m: change(m / "scheduler" / "scheduler_config.json", prediction_type="flow"),
            ["scheduler", "prediction_type", "v_prediction", "'flow'"],
        ),
        (lambda m: change(m / "unet" / "config.json", sample_size=[16, 24]), ["unet", "square", "[16, 24]"]),
    ],
)
def test_damage_is_laid_to_its_component(
    copy: Path, damage: Callable[[Path], None], words: list[str]
) -> None:
    damage(copy)
    with pytest.raises(InputError) as refusal:
        load_parts(str(copy), device="cpu")
    message = str(refusal.value)
    assert message.startswith(f"{copy}: ")
    assert "\n" not in message
    assert all(word in message for word in words), message


def test_components_of_different_models_are_refused(
    copy: Path, tiny_controlnet: Path, tmp_path: Path
) -> None:
    control = shutil.copytree(tiny_controlnet, tmp_path / "control")
    change(control / "config.json", conditioning_embedding_out_channels=[4, 8, 8])
    from diffusers import ControlNetModel

    ControlNetModel.from_config(json.loads((control / "config.json").read_text())).save_pretrained(control)
    with pytest.raises(InputError, match=r"control: controlnet: pixels to a latent, .* expected 2, found 4"):
        load_parts(str(copy), controlnet=str(control), device="cpu")
    from diffusers import UNet2DConditionModel

    settings = json.loads((copy / "unet" / "config.json").read_text())
    for key, value, words in (
        ("in_channels", 9, "unet: input channels, .* expected 4, found 9"),
        ("cross_attention_dim", 24, "unet: width of the text, .* expected 16, found 24"),
    ):
        UNet2DConditionModel.from_config(settings | {key: value}).save_pretrained(copy / "unet")
        with pytest.raises(InputError, match=words):
            load_parts(str(copy), device="cpu")


def test_a_pipelines_own_controlnet_is_found(copy: Path, tiny_controlnet: Path) -> None:
    shutil.copytree(tiny_controlnet, copy / "controlnet")
    assert load_parts(str(copy), device="cpu").controlnet is None
    found = load_parts(str(copy), controlnet=str(copy), device="cpu").controlnet.state_dict()
    assert all(torch.equal(found[k], v) for k, v in load_file(weights_file(tiny_controlnet)).items())


def test_weights_stored_in_half_precision_only(copy: Path) -> None:
    parts = load_parts(str(copy), device="cpu")
    for name in ("unet", "vae", "text_encoder"):
        weights_file(copy / name).unlink()
        getattr(parts, name).half().save_pretrained(copy / name, variant="fp16")
        assert ".fp16." in weights_file(copy / name).name
    again = load_parts(str(copy), device="cpu")
    assert again.unet.dtype == torch.float32
    for name in ("unet", "vae", "text_encoder"):
        old, new = getattr(parts, name).state_dict(), getattr(again, name).state_dict()
        assert all(torch.equal(old[key].float(), value.float()) for key, value in new.items())


@pytest.mark.parametrize(
    "sampler", ["PNDMScheduler", "EulerDiscreteScheduler", "DPMSolverMultistepScheduler"]
)
def test_the_noise_schedule_of_any_sampler_is_read(copy: Path, sampler: str) -> None:
    import diffusers

    made = getattr(diffusers, sampler)(
        beta_start=0.001, beta_end=0.02, beta_schedule="linear", prediction_type="v_prediction"
    )
    made.save_pretrained(copy / "scheduler")
    found = load_parts(str(copy), device="cpu").scheduler
    expected = torch.cumprod(1.0 - torch.linspace(0.001, 0.02, 1000), 0)
    torch.testing.assert_close(found.alphas_cumprod, expected)
    assert found.config.prediction_type == "v_prediction"


def test_a_controlnet_that_is_none_is_named(tiny_model: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected a ControlNet .* found no component controlnet"):
        load_parts(str(tiny_model), controlnet=str(tmp_path), device="cpu")


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("nobody/nothing", "nobody/nothing: .* component unet, .* pass a local folder"),
        ("/nowhere/at all", "/nowhere/at all: expected a folder .* owner/name, found neither"),
        ("model.safetensors", "expected a folder .* found neither"),
    ],
)
def test_what_is_neither_folder_nor_at_hand(source: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_parts(source, device="cpu")


def test_a_single_file_is_refused(tiny_model: Path) -> None:
    with pytest.raises(InputError, match=r"expected a folder with Stable Diffusion .* found a file"):
        load_parts(str(weights_file(tiny_model / "unet")), device="cpu")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"device": "tpu"}, "device: expected one of auto, cpu, cuda, found 'tpu'"),
        ({"device": "cpu", "precision": "float8"}, "precision: .* found 'float8'"),
        ({"device": "cpu", "precision": "float16"}, "precision: expected float32 on a CPU, found float16"),
    ],
)
def test_choices_that_cannot_be(tiny_model: Path, options: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_parts(str(tiny_model), **options)


def test_a_gpu_that_is_not_there(tiny_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="device: expected a GPU"):
        load_parts(str(tiny_model), device="cuda")


def test_a_missing_extra_is_named(tiny_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr(diffusers_folder.importlib, "import_module", absent)
    with pytest.raises(InputError, match=r"expected diffusers, .*pip install 'bigs\[diffusion\]'"):
        load_parts(str(tiny_model), device="cpu")


def test_a_broken_torchvision_is_named(tiny_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = diffusers_folder.importlib.import_module

    class Broken:
        def __getattr__(self, name: str) -> Any:
            raise RuntimeError("Failed to import\noperator torchvision::nms does not exist")

    replaced = {"diffusers": Broken()}
    monkeypatch.setattr(
        diffusers_folder.importlib, "import_module", lambda name: replaced.get(name) or real(name)
    )
    with pytest.raises(InputError, match=r"UNet2DConditionModel, .* uninstall torchvision"):
        load_parts(str(tiny_model), device="cpu")


def test_loading_says_nothing(tiny_model: Path, capfd: pytest.CaptureFixture[str]) -> None:
    load_parts(str(tiny_model), device="cpu")
    assert capfd.readouterr() == ("", "")

"""`bigs prior fit`: a clip and a model go in, a textual inversion file comes out."""

from __future__ import annotations

import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import pytest
import torch
from command_line import Answer, assert_refused
from family import Family
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from tiny_diffusion import as_pipeline

from bigs.cli import prior as cli
from bigs.commands.prior import fit as command
from bigs.commands.prior.fit import FittedToken, fit_token
from bigs.data.base import Clip
from bigs.guidance import diffusers_folder
from bigs.guidance.diffusers_folder import load_parts
from bigs.guidance.inversion import InversionConfig

CONFIG = InversionConfig("bottle", steps=4, batch=1)
QUICK = ("--object", "bottle", "--steps", "3", "--batch", "1", "--device", "cpu")


@pytest.fixture
def fit(tiny_clip: Path, tiny_model: Path) -> Callable[..., FittedToken]:
    """Learns on the tiny clip and model."""

    def run(out: Path, config: InversionConfig = CONFIG, **options: Any) -> FittedToken:
        return fit_token(
            tiny_clip, out, config, **{"model": str(tiny_model), "device": "cpu", "keep_every": 2, **options}
        )

    return run


@pytest.fixture
def short(tiny_clip: Path, tiny_model: Path, tmp_path: Path) -> list[str | Path]:
    """A call of the command that takes a second."""
    return ["prior", "fit", tiny_clip, *QUICK, "--model", tiny_model, "--out", tmp_path / "token.safetensors"]


def test_a_word_is_learned_and_written(
    call: Callable[..., Answer],
    short: list[str | Path],
    tiny_model: Path,
    tiny_controlnet: Path,
    tmp_path: Path,
) -> None:
    answer = call(*short, "--controlnet", tiny_controlnet, "--token", "<it>")
    assert answer.code == 0, answer.err
    assert "3 steps on" in answer.out
    assert "memory: " in answer.out
    assert "token.safetensors" in answer.out
    assert [path.name for path in tmp_path.iterdir()] == ["token.safetensors"]
    found = load_file(tmp_path / "token.safetensors")
    assert list(found) == ["<it>"]
    # Another program's reader.
    pipeline = as_pipeline(load_parts(str(tiny_model), device="cpu"))
    pipeline.load_textual_inversion(str(tmp_path / "token.safetensors"))
    row = pipeline.tokenizer.convert_tokens_to_ids("<it>")
    assert torch.equal(pipeline.text_encoder.get_input_embeddings().weight[row], found["<it>"][0])


class _Killed(Exception):
    pass


@pytest.mark.parametrize("at", [1, 2, 3])
def test_interrupted_work_ends_in_the_same_bytes(
    fit: Callable[..., FittedToken], tmp_path: Path, at: int
) -> None:
    fit(tmp_path / "whole.safetensors")

    def kill(event: dict[str, Any]) -> None:
        if event.get("step") == at and event["event"] == "step":
            raise _Killed

    out = tmp_path / "token.safetensors"
    with pytest.raises(_Killed):
        fit(out, listen=kill)
    assert not out.exists()
    assert (tmp_path / "token.state.safetensors").exists() == (at > 2)
    started = []
    found = fit(
        out, resume=True, listen=lambda e: started.append(e["step"]) if e["event"] == "start" else None
    )
    assert started == [2 if at > 2 else 0]
    assert found.steps == 4 - started[0]
    assert out.read_bytes() == (tmp_path / "whole.safetensors").read_bytes()
    assert not (tmp_path / "token.state.safetensors").exists()


@pytest.mark.slow
def test_killed_work_ends_in_the_same_bytes(
    family: Family, tiny_clip: Path, tiny_model: Path, tmp_path: Path, fit: Callable[..., FittedToken]
) -> None:
    """By a signal that nothing can catch, in a process of its own."""
    out, kept = tmp_path / "token.safetensors", tmp_path / "token.state.safetensors"
    arguments = (
        "--object",
        "bottle",
        "--steps",
        "100000",
        "--batch",
        "1",
        "--device",
        "cpu",
        "--threads",
        "1",
    )
    command = ["prior", "fit", tiny_clip, *arguments, "--model", tiny_model, "--out", out]
    process = family.start_bigs(*command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not kept.exists() and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    with safe_open(kept, framework="pt") as file:
        done = int(file.metadata()["step"])
    assert done >= 50
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        config = InversionConfig("bottle", steps=done + 5, batch=1)
        assert fit(out, config, resume=True).steps == 5
        fit(tmp_path / "whole.safetensors", config)
    finally:
        torch.set_num_threads(threads)
    assert out.read_bytes() == (tmp_path / "whole.safetensors").read_bytes()


def test_another_seed_learns_another_word(fit: Callable[..., FittedToken], tmp_path: Path) -> None:
    for name, seed in (("a", 0), ("b", 1)):
        fit(tmp_path / f"{name}.safetensors", InversionConfig("bottle", steps=1, batch=1, seed=seed))
    assert (tmp_path / "a.safetensors").read_bytes() != (tmp_path / "b.safetensors").read_bytes()


def test_only_object_pixels_are_learned_from(
    fit: Callable[..., FittedToken], tiny: Clip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    real = command.cut_crop
    monkeypatch.setattr(command, "cut_crop", lambda *a: seen.append(a) or real(*a))
    found = fit(tmp_path / "token.safetensors", InversionConfig("bottle", steps=1))
    assert found.frames == len(seen)
    assert {int(mask.sum()) for _, mask, _ in seen} <= set(tiny.mask_areas["object"].tolist())
    assert all(size == 32 for _, _, size in seen)


def test_a_state_of_other_work_is_refused(fit: Callable[..., FittedToken], tmp_path: Path) -> None:
    out, kept = tmp_path / "token.safetensors", tmp_path / "token.state.safetensors"

    def stop(event: dict[str, Any]) -> None:
        if event.get("step") == 3:
            raise _Killed

    with pytest.raises(_Killed):
        fit(out, listen=stop)
    with pytest.raises(command.InputError, match=r"token\.state.*pass --resume"):
        fit(out)
    with pytest.raises(command.InputError, match="expected a state of this clip, model and options"):
        fit(out, InversionConfig("bottle", steps=4, batch=2), resume=True)
    # More steps are no other work.
    assert fit(out, InversionConfig("bottle", steps=5, batch=1), resume=True).steps == 3
    save_file({"embedding": torch.zeros(1)}, kept)
    with pytest.raises(command.InputError, match="expected a new file"):
        fit(out, resume=True)
    out.unlink()
    with pytest.raises(command.InputError, match="expected a state of this clip"):
        fit(out, resume=True)
    kept.write_bytes(b"no")
    with pytest.raises(command.InputError, match="expected a readable state"):
        fit(out, resume=True)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"--out": "token.bin"}, ["token.bin", "ends in .safetensors", "found .bin"]),
        ({"--out": "nowhere/token.safetensors"}, ["nowhere", "expected a folder"]),
        ({"--model": "nowhere at all"}, ["nowhere at all", "expected a folder", "found neither"]),
        ({"--controlnet": "."}, [".: expected a ControlNet", "found no component controlnet"]),
        ({"--edge-weights": "x.pth"}, ["--edge-weights", "expected --controlnet", "found none"]),
        ({"--object": ""}, ["object name", "found none"]),
        ({"--token": "a b"}, ["token", "one word", "'a b'"]),
        ({"--token": "a</w>"}, ["token a</w>", "new to the model"]),
        ({"--steps": "0"}, ["steps", "at least 1"]),
        ({"--precision": "float16"}, ["precision", "float32 on a CPU"]),
    ],
)
def test_bad_input_is_answered_in_one_sentence(
    call: Callable[..., Answer],
    short: list[str | Path],
    tmp_path: Path,
    change: dict[str, str],
    words: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = list(short)
    for option, value in change.items():
        if option in arguments:
            arguments[arguments.index(option) + 1] = value
        else:
            arguments += [option, value]
    assert_refused(call(*arguments), *words)
    assert list(tmp_path.iterdir()) == []


def test_a_model_without_a_component_names_it(
    call: Callable[..., Answer], short: list[str | Path], tiny_model: Path, tmp_path: Path
) -> None:
    model = shutil.copytree(tiny_model, tmp_path / "model")
    shutil.rmtree(model / "vae")
    short[short.index("--model") + 1] = model
    assert_refused(call(*short), "model: expected Stable Diffusion", "found no component vae")


def test_help_and_choices_are_those_of_the_work(call: Callable[..., Answer]) -> None:
    answer = call("prior", "fit", "--help")
    assert answer.code == 0
    assert "mustard bottle" in answer.out
    assert get_args(cli.Device) == get_args(diffusers_folder.Device)
    assert get_args(cli.Precision) == get_args(diffusers_folder.Precision)

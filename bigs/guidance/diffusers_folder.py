"""The networks of a Stable Diffusion folder, checked one by one; needs the extra `diffusion`."""

from __future__ import annotations

import importlib
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from bigs.checks import InputError, check_choice

Precision = Literal["auto", "float32", "float16", "bfloat16"]
_DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}
Device = Literal["auto", "cpu", "cuda"]

# Each component of a model folder: the class that reads it, and files of which one must exist.
COMPONENTS = {
    "unet": ("diffusers.UNet2DConditionModel", ("config.json",)),
    "vae": ("diffusers.AutoencoderKL", ("config.json",)),
    "text_encoder": ("transformers.CLIPTextModel", ("config.json",)),
    "tokenizer": ("transformers.CLIPTokenizer", ("tokenizer.json", "vocab.json")),
    # Only the noise schedule of the folder's sampler is read.
    "scheduler": ("diffusers.DDIMScheduler", ("scheduler_config.json",)),
}
_NETWORKS = ("unet", "vae", "text_encoder", "controlnet")
_HUB_NAME = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
PREDICTIONS = ("epsilon", "v_prediction", "sample")


@dataclass(frozen=True)
class Parts:
    """The content of a folder: frozen networks on their device. Typed loosely, as diffusers is."""

    unet: Any
    vae: Any  # always float32: its encoder is differentiated
    text_encoder: Any
    tokenizer: Any
    scheduler: Any  # only its noise schedule is used
    controlnet: Any  # None without one

    @property
    def device(self) -> torch.device:
        device: torch.device = self.unet.device
        return device

    @property
    def networks(self) -> tuple[torch.nn.Module, ...]:
        """All that has weights."""
        found = (self.unet, self.vae, self.text_encoder, self.controlnet)
        return tuple(network for network in found if network is not None)

    @property
    def image_size(self) -> int:
        """Rows and columns of the pictures that the model was trained on."""
        return int(self.unet.config.sample_size) * vae_factor(self.vae)


def vae_factor(vae: Any) -> int:
    """Pixels to a side of one latent."""
    return int(2 ** (len(vae.config.block_out_channels) - 1))


def load_parts(
    model: str,
    *,
    controlnet: str | None = None,
    device: Device = "auto",
    precision: Precision = "auto",
    attention_slicing: bool = False,
) -> Parts:
    """Stable Diffusion 1 or 2, and a ControlNet for it.

    Only .safetensors weights are read.

    Args:
        model: a folder as diffusers saves it, or a model's name on the Hugging Face hub ("owner/name").
        controlnet: likewise, for the ControlNet; or a pipeline's folder that has one.
        device: "auto" takes a GPU if there is one.
        precision: "auto" is float16 on a GPU and float32 on a CPU, which takes nothing else. The VAE has
            float32 always.
        attention_slicing: attend in pieces, which takes less memory and more time.

    Raises:
        InputError: names the component that is missing, unreadable, or does not fit the others.
    """
    place, dtype = choose(device, precision)
    with _quiet():
        _check_source(model, "Stable Diffusion", {name: files for name, (_, files) in COMPONENTS.items()})
        if controlnet is not None:
            inner = _controlnet_folder(controlnet)
        found = {name: _load(model, name, kind, name) for name, (kind, _) in COMPONENTS.items()}
        control = None
        if controlnet is not None:
            control = _load(controlnet, "controlnet", "diffusers.ControlNetModel", inner)
    parts = Parts(**found, controlnet=control)
    _check_fit(parts, model, controlnet)
    with _quiet():
        for network in parts.networks:
            network.to(place, torch.float32 if network is parts.vae else dtype).requires_grad_(False).eval()
    if attention_slicing:
        for attending in (parts.unet, parts.controlnet):
            if attending is not None:
                attending.set_attention_slice("auto")
    return parts


def choose(device: Device, precision: Precision) -> tuple[torch.device, torch.dtype]:
    """Where the networks go, and in which precision.

    Raises:
        InputError: there is no such device, or the device does not take the precision.
    """
    check_choice("device", device, ("auto", "cpu", "cuda"))
    check_choice("precision", precision, ("auto", *_DTYPES))
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("device: expected a GPU that torch can use for cuda, found none")
    place = torch.device(device if device != "auto" else "cuda" if torch.cuda.is_available() else "cpu")
    if precision == "auto":
        return place, torch.float16 if place.type == "cuda" else torch.float32
    if precision != "float32" and place.type == "cpu":
        raise InputError(f"precision: expected float32 on a CPU, found {precision}")
    return place, _DTYPES[precision]


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(
            f"diffusion prior: expected {name.split('.')[0]}, found it is not installed "
            "(pip install 'bigs[diffusion]')"
        ) from None


def _class(name: str) -> Any:
    library, attribute = name.split(".")
    try:
        return getattr(_library(library), attribute)
    except (ImportError, RuntimeError) as error:
        # Both libraries probe for torchvision, and fail if it was built for another torch.
        raise InputError(
            f"diffusion prior: expected {name}, found an import error, perhaps from a torchvision that "
            f"does not match torch (pip uninstall torchvision; bigs needs none): {_reason(error)}"
        ) from error


def _reason(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(". ")


def _check_source(source: str, what: str, components: dict[str, tuple[str, ...]]) -> None:
    folder = Path(source)
    if folder.is_file():
        raise InputError(f"{source}: expected a folder with {what} as diffusers saves it, found a file")
    if not folder.is_dir():
        if _HUB_NAME.fullmatch(source):
            return
        raise InputError(
            f"{source}: expected a folder with {what}, or its name on the Hugging Face hub as owner/name, "
            "found neither"
        )
    for name, files in components.items():
        if not any((folder / name / file).is_file() for file in files):
            raise InputError(
                f"{source}: expected {what} as diffusers saves it, found no component {name} "
                f"({name}/{files[0]})"
            )


def _controlnet_folder(source: str) -> str:
    """Where in `source` the ControlNet is: at its top, or in the folder that pipelines have for it."""
    if (Path(source) / "config.json").is_file():
        return ""
    _check_source(source, "a ControlNet", {"controlnet": ("config.json",)})
    return "controlnet" if Path(source).is_dir() else ""


def _load(source: str, name: str, kind: str, subfolder: str) -> Any:
    reader, local = _class(kind), Path(source).is_dir()
    options: dict[str, Any] = {"subfolder": subfolder, "local_files_only": local}
    if name in _NETWORKS:
        options |= {"use_safetensors": True, "output_loading_info": True}
        stored = [file.name for file in (Path(source) / subfolder).glob("*.safetensors")]
        if local and stored and all(".fp16" in name for name in stored):
            options["variant"] = "fp16"
    try:
        loaded = reader.from_pretrained(source, **options)
    except Exception as error:  # the libraries raise many kinds of errors for damaged files
        if local:
            raise InputError(
                f"{source}: expected a readable component {name}, found: {_reason(error)}"
            ) from error
        raise InputError(
            f"{source}: expected a model of the Hugging Face hub for the component {name}, found it "
            "neither on the hub nor in the cache; pass a local folder"
        ) from error
    if name not in _NETWORKS:
        return loaded
    network, info = loaded
    if lacking := sorted(info["missing_keys"]):
        raise InputError(
            f"{source}: expected all weights of the component {name}, found no {lacking[0]} "
            f"({len(lacking)} are missing)"
        )
    return network


def _check_fit(parts: Parts, model: str, controlnet: str | None) -> None:
    """Raise `InputError` unless the components belong together and to a model of the 1 or 2 series."""
    unet, channels = parts.unet.config, parts.vae.config.latent_channels
    width, words = parts.text_encoder.config.hidden_size, parts.text_encoder.config.vocab_size

    def check(source: str, name: str, expected: object, found: object) -> None:
        if found != expected:
            raise InputError(f"{source}: {name}: expected {expected}, found {found}")

    check(model, "unet: input channels, as many as the vae's latents have", channels, unet.in_channels)
    check(model, "unet: width of the text, as the text_encoder makes it", width, unet.cross_attention_dim)
    check(model, "unet: kind of added conditions (Stable Diffusion 1 or 2)", None, unet.addition_embed_type)
    if not isinstance(unet.sample_size, int):
        raise InputError(f"{model}: unet: expected a square sample_size, found {unet.sample_size}")
    if len(parts.tokenizer) > words:
        raise InputError(
            f"{model}: tokenizer: expected at most the {words} words of the text_encoder, "
            f"found {len(parts.tokenizer)}"
        )
    check_choice(f"{model}: scheduler: prediction_type", parts.scheduler.config.prediction_type, PREDICTIONS)
    # Some tokenizers state no limit, and longer texts would overrun the encoder.
    limit = parts.text_encoder.config.max_position_embeddings
    parts.tokenizer.model_max_length = min(parts.tokenizer.model_max_length, limit)
    if controlnet is None or parts.controlnet is None:
        return
    control = parts.controlnet.config
    shrinks = 2 ** (len(control.conditioning_embedding_out_channels) - 1)
    check(controlnet, "controlnet: input channels, as the unet has", unet.in_channels, control.in_channels)
    check(controlnet, "controlnet: width of the text, as the unet has", width, control.cross_attention_dim)
    check(controlnet, "controlnet: pixels to a latent, as the vae has", vae_factor(parts.vae), shrinks)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the libraries' progress bars, reports and advice from the terminal; errors still come through."""
    loggers = [_library(f"{name}.utils.logging") for name in ("diffusers", "transformers")]
    levels = [logger.get_verbosity() for logger in loggers]
    bars = [logger.is_progress_bar_enabled() for logger in loggers]
    for logger in loggers:
        logger.set_verbosity_error()
        logger.disable_progress_bar()
    try:
        with warnings.catch_warnings():
            # The versions that fit together here deprecate each other's arguments.
            warnings.filterwarnings("ignore", message=".*local_dir_use_symlinks", category=UserWarning)
            warnings.simplefilter("ignore", FutureWarning)
            yield
    finally:
        for logger, level, bar in zip(loggers, levels, bars, strict=True):
            logger.set_verbosity(level)
            if bar:
                logger.enable_progress_bar()

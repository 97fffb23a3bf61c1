"""`bigs prior`: teaching a diffusion model the object of a clip."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from bigs.atomic import atomic_write
from bigs.bench.machine import largest_so_far
from bigs.checks import InputError
from bigs.commands.clips.open import open_clip
from bigs.data.base import Clip
from bigs.files import check_regular
from bigs.guidance.crops import Crop, choose_frames, cut_crop
from bigs.guidance.diffusers import edge_detector
from bigs.guidance.diffusers_folder import Device, Parts, Precision, load_parts
from bigs.guidance.inversion import Inversion, InversionConfig
from bigs.guidance.token_file import write_token
from bigs.hand import load_hand_models
from bigs.types import MASK_VALUES

__all__ = ["FittedToken", "InversionConfig", "fit_token"]

FORMAT = "bigs-token-state-1"
# Frames whose crops are kept in memory.
_MOST_FRAMES = 64
_GIB = 2.0**30


class FittedToken(NamedTuple):
    """The result of `fit_token`."""

    path: Path
    steps: int  # taken now, without those of before
    loss: float  # mean over the last tenth of these
    frames: int  # that the object was cut out of
    weights_gib: float  # of all networks
    peak_gib: float  # of the GPU's memory, or of the process's on a CPU


def fit_token(
    clip_path: Path,
    out: Path,
    config: InversionConfig,
    *,
    model: str,
    controlnet: str | None = None,
    edge_weights: Path | None = None,
    device: Device = "auto",
    precision: Precision = "auto",
    attention_slicing: bool = False,
    resume: bool = False,
    keep_every: int = 50,
    listen: Callable[[dict[str, Any]], None] = lambda event: None,
) -> FittedToken:
    """Learn a word for the object of a clip, and write it as a textual inversion file.

    While it works, what is needed to go on lies beside `out`; killed at any instant, it can be resumed and
    ends in the same bytes, on the same machine with as many threads.

    Args:
        clip_path: a clip with object masks, of any layout.
        out: the .safetensors file to write.
        config: the word and how it is learned.
        model: Stable Diffusion, a folder or a hub name; `controlnet` likewise, a soft-edge ControlNet.
        edge_weights: PiDiNet for the ControlNet's pictures; the built-in filter without it.
        device, precision, attention_slicing: see `load_parts`.
        resume: go on from what lies beside `out`, if anything does.
        keep_every: steps between the states that are kept.
        listen: told what happens: "start", "step".

    Raises:
        InputError: something given is missing or does not fit; one sentence says what.
        FloatingPointError: a gradient is not finite.
    """
    kept = state_path(out, resume)
    if edge_weights is not None and controlnet is None:
        raise InputError("--edge-weights: expected --controlnet, which looks at the edges, found none")
    clip = open_clip(clip_path, load_hand_models(None))
    frames = choose_frames(str(clip_path), clip.mask_areas["object"], _MOST_FRAMES)
    edges = edge_detector(edge_weights)
    parts = load_parts(
        model, controlnet=controlnet, device=device, precision=precision, attention_slicing=attention_slicing
    )
    inversion = Inversion(parts, config)
    origin = _digest(clip, config, model, controlnet, edge_weights)
    if kept.exists():
        inversion.restore(*read_state(kept, FORMAT, origin, "this clip, model and options"))
    crops = [_cut(clip, frame, parts.image_size) for frame in frames]
    weights_gib = sum(p.nbytes for network in parts.networks for p in network.parameters()) / _GIB
    listen({"event": "start", "frames": len(frames), "weights_gib": weights_gib, "step": inversion.step})
    losses = []
    while inversion.step < config.steps:
        losses.append(inversion.take_step(crops, edges))
        listen({"event": "step", "step": inversion.step, "steps": config.steps, "loss": losses[-1]})
        if inversion.step % keep_every == 0:
            _keep(inversion, kept, origin)
    write_token(out, inversion.token)
    kept.unlink(missing_ok=True)
    last = losses[-max(1, len(losses) // 10) :]
    loss = sum(last) / len(last) if last else float("nan")
    return FittedToken(out, len(losses), loss, len(frames), weights_gib, _peak_gib(parts))


def state_path(out: Path, resume: bool) -> Path:
    """Where the state lies while `out` is made.

    Raises:
        InputError: `out` cannot be written, is there already, or is half made and `resume` is not set.
    """
    if out.suffix != ".safetensors":
        raise InputError(
            f"{out}: expected a file name that ends in .safetensors, found {out.suffix or 'none'}"
        )
    if not out.parent.is_dir():
        raise InputError(f"{out}: expected a folder {out.parent} to write into, found none")
    if out.exists():
        raise InputError(f"{out}: expected a new file, found one that is there already")
    kept = out.with_suffix(".state.safetensors")
    if kept.exists() and not resume:
        raise InputError(
            f"{kept}: expected no earlier work on {out.name}, found some (pass --resume to go on from it)"
        )
    return kept


def _cut(clip: Clip, frame: int, size: int) -> Crop:
    return cut_crop(clip.image(frame), clip.mask(frame) == MASK_VALUES["object"], size)


def _digest(
    clip: Clip, config: InversionConfig, model: str, controlnet: str | None, edge_weights: Path | None
) -> str:
    """Identifies everything that the result depends on, save how many steps are taken."""
    settings = {**asdict(config), "steps": None}
    origin = (settings, model, controlnet, str(edge_weights), clip.name, clip.frame_names)
    digest = hashlib.sha256(json.dumps(origin).encode())
    digest.update(clip.mask_areas["object"].astype("<i8").tobytes())
    return digest.hexdigest()[:16]


def _keep(inversion: Inversion, path: Path, origin: str) -> None:
    metadata = {"format": FORMAT, "origin": origin, "step": str(inversion.step)}
    with atomic_write(path) as file:
        file.write(save(inversion.state(), metadata))


def read_state(path: Path, form: str, origin: str, of_what: str) -> tuple[dict[str, torch.Tensor], int]:
    """The saved state of a training, and its number of steps.

    Raises:
        InputError: damaged, or not of this `form` and `origin`; `of_what` says what those depend on.
    """
    check_regular(path, "a readable state")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(
            f"{path}: expected a readable state, found: {error} (remove it to start again)"
        ) from error
    if metadata.get("format") != form or metadata.get("origin") != origin:
        raise InputError(
            f"{path}: expected a state of {of_what}, found one of others (remove it to start again)"
        )
    return state, int(metadata["step"])


def _peak_gib(parts: Parts) -> float:
    if parts.device.type == "cuda":
        return torch.cuda.max_memory_allocated(parts.device) / _GIB
    return largest_so_far() / _GIB

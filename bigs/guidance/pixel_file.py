"""A trained pixel denoiser as one safetensors file."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from bigs.atomic import atomic_write
from bigs.checks import InputError
from bigs.files import check_regular
from bigs.guidance.pixel import PixelConfig, PixelDenoiser, PixelNet

FORMAT = "bigs-pixel-prior-2"


def save_pixel_net(path: Path, net: PixelNet, familiar: float) -> None:
    """Write a network, and what `Denoiser.familiar` says of it; whole or not at all."""
    about = {"format": FORMAT, "config": asdict(net.config), "familiar": familiar}
    metadata = {"bigs": json.dumps(about)}
    with atomic_write(path) as file:
        file.write(save({name: value.contiguous() for name, value in net.state_dict().items()}, metadata))


def load_pixel_denoiser(path: Path) -> PixelDenoiser:
    """Read what `save_pixel_net` wrote.

    Raises:
        InputError: missing, damaged, or another program's file.
    """
    check_regular(path, "a file of bigs prior train")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = json.loads((file.metadata() or {}).get("bigs", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(
            f"{path}: expected a file of bigs prior train, found a damaged one ({error})"
        ) from error
    if metadata.get("format") != FORMAT:
        raise InputError(f"{path}: expected format {FORMAT}, found {metadata.get('format')}")
    try:
        net = PixelNet(PixelConfig(**metadata["config"]))
        net.load_state_dict(tensors)
        familiar = float(metadata["familiar"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"{path}: expected a whole prior, found one with parts missing ({reason})"
        ) from error
    return PixelDenoiser(net, familiar=familiar)

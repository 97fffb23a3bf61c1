"""Reading the weights of networks from the files that others publish, without running anything in them."""

from __future__ import annotations

import pickle
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from bigs.checks import InputError, check_finite, check_shape
from bigs.files import check_regular

# What torch raises for files that are no checkpoint, are cut short, or hold more than plain data.
_UNREADABLE = (
    SafetensorError,
    pickle.UnpicklingError,
    RuntimeError,
    OSError,
    EOFError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
)


def load_weights(path: Path, network: str) -> dict[str, Tensor]:
    """The tensors in a state dict, by name; one below "state_dict" is found, too.

    Args:
        path: a .safetensors file, or what `torch.save` wrote.
        network: what the file should hold, for messages.

    Raises:
        InputError: the file is missing or unreadable, or holds other things than tensors by name.
    """
    check_regular(path, f"a file with {network}")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
    except _UNREADABLE as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(
            f"{path}: expected tensors by name (.safetensors or .pth), found another file ({reason})"
        ) from error
    if isinstance(content, dict) and isinstance(content.get("state_dict"), dict):
        content = content["state_dict"]
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected tensors by name, found {type(content).__name__}")
    return {
        key: value for key, value in content.items() if isinstance(key, str) and isinstance(value, Tensor)
    }


def checked_weight(where: str, value: Tensor, shape: tuple[int | str | None, ...]) -> Tensor:
    """`value` as float32, whatever the precision it is stored in.

    Args:
        where: file and name, for messages.
        value: the tensor.
        shape: as in `check_shape`.

    Raises:
        InputError: another shape, or values that are not finite.
    """
    check_shape(where, value, shape)
    value = value.float().contiguous()
    check_finite(where, value)
    return value

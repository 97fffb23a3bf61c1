"""Reading the weights of networks from the files that others publish, without running anything in them."""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from bigs.checks import InputError, check_finite, check_shape
from bigs.files import check_regular, open_regular
from bigs.torch_files import load_torch


def load_weights(path: Path, network: str) -> dict[str, Tensor]:
    """The tensors in a state dict, by name; one below "state_dict" is found, too.

    Args:
        path: a .safetensors file, or what `torch.save` wrote.
        network: what the file should hold, for messages.

    Raises:
        InputError: the file is missing or unreadable, or holds other things than tensors by name.
    """
    what, wanted = f"a file with {network}", "tensors by name (.safetensors or .pth)"
    if path.suffix == ".safetensors":
        check_regular(path, what)
        try:
            return load_file(path)
        except (SafetensorError, OSError, ValueError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(f"{path}: expected {wanted}, found another file ({reason})") from None
    with open_regular(path, what) as stream:
        content = load_torch(str(path), stream, wanted)
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

"""What the one call is given: that it fits together, and the sizes that follow."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from bigs.checks import InputError, check_finite, check_shape

# A rotation part whose volume is this small a part of the product of its rows' lengths is singular.
_SINGULAR = 1e-9


class Batch(NamedTuple):
    """Sizes that the inputs agree on."""

    shape: tuple[int, ...]  # the "..." axes together
    cameras: int
    width: int
    height: int
    colors_per_camera: bool
    sh_degree: int | None


def check_kind(tensors: dict[str, torch.Tensor], pixel_mask: torch.Tensor | None) -> None:
    """All inputs are tensors of one floating type on one device, and the mask is boolean.

    Raises:
        InputError: one is not; it is named.
    """
    means = tensors["means"]
    for name, tensor in tensors.items():
        if not isinstance(tensor, torch.Tensor):
            raise InputError(f"{name}: expected a torch tensor, found {type(tensor).__name__}")
        if tensor.dtype not in (torch.float32, torch.float64):
            raise InputError(f"{name}: expected dtype float32 or float64, found {tensor.dtype}")
        if tensor.dtype != means.dtype:
            raise InputError(f"{name}: expected the dtype of means, {means.dtype}, found {tensor.dtype}")
        if tensor.device != means.device:
            raise InputError(f"{name}: expected the device of means, {means.device}, found {tensor.device}")
    if pixel_mask is not None:
        if not isinstance(pixel_mask, torch.Tensor) or pixel_mask.dtype != torch.bool:
            found = getattr(pixel_mask, "dtype", type(pixel_mask).__name__)
            raise InputError(f"pixel_mask: expected a bool tensor, found {found}")
        if pixel_mask.device != means.device:
            raise InputError(
                f"pixel_mask: expected the device of means, {means.device}, found {pixel_mask.device}"
            )


def batch_of(
    tensors: dict[str, torch.Tensor],
    pixel_mask: torch.Tensor | None,
    width: int,
    height: int,
    sh_degree: int | None,
) -> Batch:
    """The sizes of all inputs.

    Raises:
        InputError: a shape does not fit the others; it is named.
    """
    for name, size in (("width", width), ("height", height)):
        if not isinstance(size, int | np.integer) or size < 1:
            raise InputError(f"{name}: expected a positive whole number of pixels, found {size!r}")
    # A tensor with too few axes to tell a size fails its own check below, whatever this says.
    n = tensors["means"].shape[-2] if tensors["means"].ndim >= 2 else 1
    cameras = tensors["viewmats"].shape[-3] if tensors["viewmats"].ndim >= 3 else 1
    channels = tensors["colors"].shape[-1] if tensors["colors"].ndim >= 2 else 1
    if channels == 0 or cameras == 0:
        name, what = ("colors", "channel") if channels == 0 else ("viewmats", "camera")
        raise InputError(f"{name}: expected at least one {what}, found shape {list(tensors[name].shape)}")
    color = (channels,) if sh_degree is None else tuple(tensors["colors"].shape[-2:])
    trailing: dict[str, tuple[int, ...]] = {
        "means": (n, 3),
        "quats": (n, 4),
        "scales": (n, 3),
        "opacities": (n,),
        "colors": (n, *color),
        "viewmats": (cameras, 4, 4),
        "Ks": (cameras, 3, 3),
        "backgrounds": (cameras, channels),
        "pixel_mask": (cameras, height, width),
    }
    leading: dict[str, tuple[int, ...]] = {}
    for name, tensor in (tensors if pixel_mask is None else {**tensors, "pixel_mask": pixel_mask}).items():
        expected = trailing[name]
        if tuple(tensor.shape[max(tensor.ndim - len(expected), 0) :]) != expected:
            shown = ", ".join(map(str, ("...", *expected)))
            raise InputError(f"{name}: expected shape [{shown}], found {list(tensor.shape)}")
        leading[name] = tuple(tensor.shape[: tensor.ndim - len(expected)])

    depth = max(len(axes) for name, axes in leading.items() if name != "colors")
    colors_per_camera = len(leading["colors"]) == depth + 1
    if colors_per_camera:
        check_shape("colors", tensors["colors"], [None] * depth + [cameras, n, *color])
        leading["colors"] = leading["colors"][:-1]
    shape = _broadcast(leading)
    if 0 in shape:
        raise InputError(f"batch axes: expected at least one entry, found {list(shape)}")
    return Batch(shape, cameras, int(width), int(height), colors_per_camera, sh_degree)


def _broadcast(leading: dict[str, tuple[int, ...]]) -> tuple[int, ...]:
    different = {axes for axes in leading.values() if axes}
    if len(different) <= 1:  # the usual case; torch takes longer to say so
        return different.pop() if different else ()
    try:
        return tuple(torch.broadcast_shapes(*leading.values()))
    except RuntimeError:
        found = ", ".join(f"{name} {list(axes)}" for name, axes in leading.items())
        raise InputError(f"batch axes: expected shapes that broadcast, found {found}") from None


def check_cameras(viewmats: torch.Tensor, Ks: torch.Tensor) -> None:
    """World-to-camera matrices [..., C, 4, 4] can be inverted, intrinsics [..., C, 3, 3] are a pinhole's.

    Raises:
        InputError: the first that is not, with its index.
    """
    check_finite("viewmats", viewmats)
    check_finite("Ks", Ks)
    views, matrices = (x.detach().cpu().numpy().astype(np.float64) for x in (viewmats, Ks))
    rotations = views[..., :3, :3]
    # In units of each row's largest entry, so that no product leaves the range of numbers.
    rotations = rotations / np.abs(rotations).max(-1, keepdims=True).clip(min=np.finfo(np.float32).tiny)
    volume = np.prod(np.linalg.norm(rotations, axis=-1), axis=-1)
    problems = (
        ("viewmats", "0 0 0 1 as the last row", (views[..., 3, :] != [0, 0, 0, 1]).any(-1)),
        ("viewmats", "an invertible 3×3 part", np.abs(np.linalg.det(rotations)) <= _SINGULAR * volume),
        ("Ks", "positive focal lengths", (matrices[..., 0, 0] <= 0) | (matrices[..., 1, 1] <= 0)),
        ("Ks", "no skew", (matrices[..., 0, 1] != 0) | (matrices[..., 1, 0] != 0)),
        ("Ks", "0 0 1 as the last row", (matrices[..., 2, :] != [0, 0, 1]).any(-1)),
    )
    for name, expected, wrong in problems:
        if wrong.any():
            index = tuple(int(i) for i in np.argwhere(wrong)[0])
            found = (views if name == "viewmats" else matrices)[index].tolist()
            raise InputError(f"{name}: expected {expected}, found {found} at index {list(index)}")

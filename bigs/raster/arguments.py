"""Checks of the renderer's arguments, and the sizes that follow from them."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch

from bigs.checks import InputError, check_finite

# A rotation part is singular if its volume is less than this part of the product of its rows' lengths.
_SINGULAR = 1e-9
# Limit over all images of a call, 8 GB in single precision: broadcast axes can announce any number.
_MAX_VALUES = 1 << 31
# Size of the cache of what follows from shapes alone; a loop repeats the same shapes.
_REMEMBERED = 64

# Name and shape of each given input.
Shapes = tuple[tuple[str, tuple[int, ...]], ...]

# The engine's order of inputs, with the number of own axes and whether camera axes come before them; colours
# vary.
_AXES = {
    "means": (2, False),
    "quats": (2, False),
    "scales": (2, False),
    "opacities": (1, False),
    "colors": (2, None),
    "viewmats": (2, True),
    "Ks": (2, True),
    "backgrounds": (1, True),
    "pixel_mask": (2, True),
}


class Batch(NamedTuple):
    """Sizes that the inputs agree on."""

    shape: tuple[int, ...]  # the "..." axes together
    cameras: int
    width: int
    height: int
    colors_per_camera: bool
    sh_degree: int | None


def check_kind(tensors: dict[str, torch.Tensor], pixel_mask: torch.Tensor | None) -> None:
    """All inputs are dense tensors of one floating type on one device, and the mask is boolean.

    Raises:
        InputError: one is not; it is named.
    """
    means = tensors["means"]
    for name, tensor in tensors.items():
        if not isinstance(tensor, torch.Tensor):
            raise InputError(f"{name}: expected a torch tensor, found {type(tensor).__name__}")
        if tensor.layout != torch.strided:
            raise InputError(f"{name}: expected a dense tensor, found layout {tensor.layout}")
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
        if pixel_mask.layout != torch.strided:
            raise InputError(f"pixel_mask: expected a dense tensor, found layout {pixel_mask.layout}")
        if pixel_mask.device != means.device:
            raise InputError(
                f"pixel_mask: expected the device of means, {means.device}, found {pixel_mask.device}"
            )


class Broadcast(NamedTuple):
    """How the engine reads its inputs: one entry per input, in its order."""

    counts: tuple[tuple[int, int], ...]
    """How many batch entries and cameras (or 1: shared) the leading axes stand for."""
    shapes: tuple[tuple[int, ...] | None, ...]
    """The shape to expand an input to where its batch axes broadcast along some only."""


def shapes_of(tensors: dict[str, torch.Tensor], pixel_mask: torch.Tensor | None) -> Shapes:
    """The shapes of all inputs."""
    shapes = tuple([(name, tensor.shape) for name, tensor in tensors.items()])
    return shapes if pixel_mask is None else (*shapes, ("pixel_mask", pixel_mask.shape))


def batch_of(shapes: Shapes, width: int, height: int, sh_degree: int | None) -> Batch:
    """The sizes of all inputs.

    Raises:
        InputError: a shape does not fit the others; it is named.
    """
    for name, size in (("width", width), ("height", height)):
        if not isinstance(size, int | np.integer) or size < 1:
            raise InputError(f"{name}: expected a positive whole number of pixels, found {size!r}")
    return _fitted(shapes, int(width), int(height), sh_degree)


@lru_cache(_REMEMBERED)
def _fitted(shapes: Shapes, width: int, height: int, sh_degree: int | None) -> Batch:
    found = {name: tuple(shape) for name, shape in shapes}
    # A tensor with too few axes to tell a size fails its own check below.
    n = found["means"][-2] if len(found["means"]) >= 2 else 1
    cameras = found["viewmats"][-3] if len(found["viewmats"]) >= 3 else 1
    channels = found["colors"][-1] if len(found["colors"]) >= 2 else 1
    if channels == 0 or cameras == 0:
        name, what = ("colors", "channel") if channels == 0 else ("viewmats", "camera")
        raise InputError(f"{name}: expected at least one {what}, found shape {list(found[name])}")
    color = (channels,) if sh_degree is None else found["colors"][-2:]
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
    for name, shape in found.items():
        expected = trailing[name]
        if shape[max(len(shape) - len(expected), 0) :] != expected:
            shown = ", ".join(map(str, ("...", *expected)))
            raise InputError(f"{name}: expected shape [{shown}], found {list(shape)}")
        leading[name] = shape[: len(shape) - len(expected)]

    depth = max(len(axes) for name, axes in leading.items() if name != "colors")
    colors_per_camera = len(leading["colors"]) == depth + 1
    if colors_per_camera:
        if leading["colors"][-1] != cameras:
            shown = ", ".join(map(str, (*["any"] * depth, cameras, n, *color)))
            raise InputError(f"colors: expected shape [{shown}], found {list(found['colors'])}")
        leading["colors"] = leading["colors"][:-1]
    batch = _broadcast(leading)
    if 0 in batch:
        raise InputError(f"batch axes: expected at least one entry, found {list(batch)}")
    images = math.prod(batch) * cameras
    # Each pixel has colours, alpha and depth; each Gaussian in each image has a place, depth and extent.
    for name, each in (("width and height", width * height * (channels + 2)), ("means", 5 * n)):
        if images * each > _MAX_VALUES:
            raise InputError(
                f"{name}: expected at most {_MAX_VALUES} values in all images, found {images * each} "
                f"({images} images of {width} x {height} pixels, {channels} channels and {n} Gaussians)"
            )
    return Batch(batch, cameras, width, height, colors_per_camera, sh_degree)


@lru_cache(_REMEMBERED)
def broadcast_of(shapes: Shapes, batch: Batch) -> Broadcast:
    """How the engine is to read inputs of these shapes, which `batch_of` has found to fit."""
    found = dict(shapes)
    counts: list[tuple[int, int]] = []
    wider: list[tuple[int, ...] | None] = []
    for name, (own, per_camera) in _AXES.items():
        per_camera = batch.colors_per_camera if per_camera is None else per_camera
        count, shape = 1, None
        if name in found:
            depth = len(found[name]) - own - per_camera
            lead, rest = tuple(found[name][:depth]), tuple(found[name][depth:])
            count = math.prod(lead)
            if count != 1 and lead != batch.shape:
                count, shape = math.prod(batch.shape), (*batch.shape, *rest)
        counts.append((count, batch.cameras if per_camera and name in found else 1))
        wider.append(shape)
    return Broadcast(tuple(counts), tuple(wider))


def _broadcast(leading: dict[str, tuple[int, ...]]) -> tuple[int, ...]:
    different = {axes for axes in leading.values() if axes}
    if len(different) <= 1:  # the usual case, which torch takes longer to find
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
    # In units of each row's largest entry, so that no product overflows.
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

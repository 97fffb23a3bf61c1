"""Gaussians as the PLY file of 3D Gaussian splatting, which every splat viewer opens.

Binary little endian, one float32 vertex property per number: position, an unused normal, colour as the
constant spherical harmonic, opacity before the sigmoid, logarithms of the scales, quaternion w x y z.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from bigs.atomic import atomic_write
from bigs.checks import InputError, check_finite, check_shape
from bigs.files import open_regular
from bigs.types import Gaussians

# rgb = 0.5 + SH_C0 * f_dc, the constant real spherical harmonic
SH_C0 = 0.28209479177387814
# An opacity of exactly 0 or 1 has no finite logit; a scale of 0 has no finite logarithm.
_OPACITY_MARGIN = 1e-6
_MIN_SCALE = 1e-12

_MEANS = ("x", "y", "z")
_COLORS = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_WRITTEN = (*_MEANS, "nx", "ny", "nz", *_COLORS, "opacity", *_SCALES, *_QUATS)

_TYPES = {
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
}
# No splat file has a longer header; the limit keeps a wrong file from being searched to its end.
_MAX_HEADER = 64 * 1024


def save_splats(path: str | Path, gaussians: Gaussians) -> None:
    """Write one set of Gaussians; `path` is whole or absent.

    Opacities of 0 and 1 are moved inside by 1e-6 and quaternions are normalised; the rest is exact in
    float32.

    Args:
        path: the file to write.
        gaussians: means [N, 3] metres, colours [N, 3].

    Raises:
        InputError: a shape does not fit, or a value is not finite.
    """
    check_splats(str(path), gaussians)
    means, quats, log_scales, logits, harmonics = stored_form(gaussians)
    count = len(means)
    unused_normals = torch.zeros(count, 3, dtype=torch.float64)
    table = torch.cat((means, unused_normals, harmonics, logits[:, None], log_scales, quats), dim=1)
    properties = "".join(f"property float {name}\n" for name in _WRITTEN)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n"
    with atomic_write(path) as file:
        file.write(header.encode("ascii"))
        file.write(table.numpy().astype("<f4").tobytes())


def check_splats(where: str, gaussians: Gaussians) -> None:
    """Refuse what is not one set of N Gaussians with three colour channels.

    Raises:
        InputError: a shape does not fit, or a value is not finite.
    """
    count = len(gaussians.means)
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 3))
    for name, values, shape in zip(Gaussians._fields, gaussians, shapes, strict=True):
        check_shape(f"{where}: {name}", values, shape)
        check_finite(f"{where}: {name}", values)


def stored_form(gaussians: Gaussians) -> Gaussians:
    """The numbers that splat files hold, float64: unit quaternions, logarithms of scales, logits of
    opacities, constant harmonics for colours."""
    means, quats, scales, opacities, colors = (values.detach().cpu().double() for values in gaussians)
    return Gaussians(
        means,
        torch.nn.functional.normalize(quats, dim=-1),
        scales.clamp_min(_MIN_SCALE).log(),
        torch.logit(opacities.clamp(_OPACITY_MARGIN, 1.0 - _OPACITY_MARGIN)),
        (colors - 0.5) / SH_C0,
    )


def load_splats(path: str | Path) -> Gaussians:
    """Read a splat PLY: float32 tensors, quaternions as stored.

    Higher spherical harmonics and any other scalar properties are passed over, so a view-dependent colour is
    read as its mean over all directions.

    Raises:
        InputError: the file is missing, not a binary little-endian PLY, lacks a property, is cut short or too
            long, or holds a value that is not finite.
    """
    path = Path(path)
    with open_regular(path, "a splat PLY file") as file:
        count, dtype = _read_header(path, file)
        expected = count * dtype.itemsize
        body = file.read(expected + 1)
    if len(body) != expected:
        raise InputError(
            f"{path}: expected {expected} bytes after the header "
            f"({count} vertices of {dtype.itemsize} bytes), found {len(body)}"
        )
    table = np.frombuffer(body, dtype)

    def columns(names: tuple[str, ...]) -> torch.Tensor:
        for name in names:
            check_finite(f"{path}: {name}", table[name])
        return torch.from_numpy(np.stack([table[name] for name in names], axis=-1).astype(np.float32))

    return Gaussians(
        means=columns(_MEANS),
        quats=columns(_QUATS),
        scales=columns(_SCALES).exp(),
        opacities=columns(("opacity",))[:, 0].sigmoid(),
        colors=0.5 + SH_C0 * columns(_COLORS),
    )


def _read_header(path: Path, file: BinaryIO) -> tuple[int, np.dtype]:
    """Number of vertices and the layout of one; the file is left at the first vertex."""
    start = file.read(_MAX_HEADER)
    end = re.search(rb"\nend_header\r?\n", start)
    if not start.startswith(b"ply") or end is None:
        raise InputError(f"{path}: expected a PLY file, found something else")
    file.seek(end.end())
    lines = [line.split() for line in start[: end.start()].decode("ascii", "replace").splitlines()[1:]]
    lines = [words for words in lines if words and words[0] not in ("comment", "obj_info")]
    if not lines or lines[0] != ["format", "binary_little_endian", "1.0"]:
        found = " ".join(lines[0]) if lines else "nothing"
        raise InputError(f"{path}: expected format binary_little_endian 1.0, found {found}")
    if len(lines) < 2 or lines[1][:2] != ["element", "vertex"] or not lines[1][-1].isdecimal():
        found = " ".join(lines[1]) if len(lines) > 1 else "nothing"
        raise InputError(f"{path}: expected 'element vertex N' as the first element, found {found!r}")
    fields: dict[str, str] = {}
    for words in lines[2:]:
        if len(words) != 3 or words[0] != "property" or words[1] not in _TYPES or words[2] in fields:
            raise InputError(
                f"{path}: expected scalar vertex properties of one element, found {' '.join(words)!r}"
            )
        fields[words[2]] = _TYPES[words[1]]
    for name in (*_MEANS, *_COLORS, "opacity", *_SCALES, *_QUATS):
        if name not in fields:
            raise InputError(f"{path}: expected vertex property {name}, found {', '.join(fields) or 'none'}")
    return int(lines[1][-1]), np.dtype(list(fields.items()))

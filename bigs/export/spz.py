"""Gaussians as Niantic's SPZ, about a tenth of the size of a PLY, which web viewers load."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

from bigs.atomic import atomic_write, named_errors
from bigs.checks import InputError
from bigs.export.ply import check_splats, stored_form
from bigs.export.splat_glb import opengl_axes
from bigs.types import Gaussians

# Positions are 24-bit fixed-point numbers, with the finest step that still reaches the farthest one.
_POSITION_BITS = 23
_FINEST_STEP_BITS = 20


def save_spz(path: str | Path, gaussians: Gaussians) -> None:
    """Write one set of Gaussians in the axes that SPZ has (y up); `path` is whole or absent.

    Positions are exact to a few micrometres within some metres, colours and opacities to 8 bits, scales to
    3 %.

    Args:
        path: the .spz file.
        gaussians: means [N, 3] metres, colours [N, 3], OpenCV camera axes.

    Raises:
        InputError: gsply is not installed, a shape does not fit, or a value is not finite.
    """
    try:
        from gsply import GSData, write_spz
    except ImportError as error:
        raise InputError(
            f"{path}: expected the extra 'export' (pip install 'bigs[export]'), found no gsply"
        ) from error
    check_splats(str(path), gaussians)
    means, quats, log_scales, logits, harmonics = (
        values.float().numpy() for values in stored_form(opengl_axes(gaussians))
    )
    reach = max(float(abs(means).max(initial=0.0)), 1e-6)
    bits = min(_FINEST_STEP_BITS, _POSITION_BITS - 1 - math.ceil(math.log2(reach)))
    data = GSData.from_arrays(
        means=means, scales=log_scales, quats=quats, opacities=logits, sh0=harmonics, format="ply"
    )
    with tempfile.TemporaryDirectory() as folder, named_errors(path):
        file = Path(folder) / "splats.spz"
        write_spz(file, data, fractional_bits=max(1, bits))
        content = file.read_bytes()
    with atomic_write(path) as out:
        out.write(content)

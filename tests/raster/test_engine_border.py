"""The compiled engine itself, called as `bigs.raster` never would: errors, and no panic."""

import os
import subprocess
import sys

import numpy as np
import pytest

import bigs._raster as _raster
from bigs.raster.settings import RasterSettings

SHARED = ((1, 1),) * 9


def arrays(n: int = 6, channels: int = 3) -> tuple:
    """Gaussians, a camera, no background, no mask."""
    rng = np.random.default_rng(3)
    means = rng.uniform(-0.3, 0.3, (n, 3)) + np.array([0.0, 0.0, 2.0])
    return (
        means.astype(np.float32),
        rng.normal(size=(n, 4)).astype(np.float32),
        rng.uniform(0.05, 0.2, (n, 3)).astype(np.float32),
        rng.uniform(0.2, 0.9, n).astype(np.float32),
        rng.uniform(0.0, 1.0, (n, channels)).astype(np.float32),
        np.eye(4, dtype=np.float32),
        np.array([[20, 0, 8], [0, 20, 8], [0, 0, 1]], dtype=np.float32),
        None,
        None,
    )


def forward(
    inputs: tuple, counts: tuple = SHARED, size: tuple[int, int] = (16, 16), mode: str = "RGB"
) -> tuple:
    return _raster.rasterize_forward(inputs, counts, (), *size, RasterSettings(), mode, "pinhole")


def test_a_state_takes_only_the_gaussians_it_was_made_with() -> None:
    inputs = arrays()
    state = forward(inputs)[-1]
    v_colors = np.ones((16, 16, 3), dtype=np.float32)
    wanted = (True,) * 9
    means = _raster.rasterize_backward(state, inputs[:5], SHARED[:5], v_colors, None, wanted)[0]
    assert means.shape == (18,) and np.isfinite(means).all() and means.any()
    for n, channels in ((5, 3), (7, 3), (0, 3), (6, 4), (6, 1)):
        with pytest.raises(ValueError, match="expected"):
            _raster.rasterize_backward(state, arrays(n, channels)[:5], SHARED[:5], v_colors, None, wanted)
    for shape in ((15, 16, 3), (16, 16, 4), (0,)):
        with pytest.raises(ValueError, match="v_colors: expected 768 elements"):
            _raster.rasterize_backward(
                state, inputs[:5], SHARED[:5], np.ones(shape, dtype=np.float32), None, wanted
            )


def test_sizes_beyond_numbers_are_value_errors() -> None:
    inputs = arrays()
    huge = (2**32, 2**32)
    with pytest.raises(ValueError, match="batch: expected at most 2\\^20 images"):
        forward(inputs, ((1, 1),) * 5 + (huge,) + ((1, 1),) * 3)
    with pytest.raises(ValueError, match="65536 pixels a side"):
        forward(inputs, size=(2**62, 16))
    with pytest.raises(ValueError, match="at least one channel"):
        forward(arrays(channels=0))


def test_arrays_in_another_order_are_refused_and_not_misread() -> None:
    inputs = arrays()
    for index, name in enumerate(("means", "quats", "scales")):
        turned = [*inputs]
        turned[index] = np.asfortranarray(inputs[index])
        with pytest.raises(ValueError, match=f"{name}: expected a C-contiguous array"):
            forward(tuple(turned))
        turned[index] = np.ascontiguousarray(inputs[index].T)
        with pytest.raises(ValueError, match=f"{name}: expected . values on the last axis"):
            forward(tuple(turned))


def test_an_unknown_instruction_set_is_named_with_those_that_there_are() -> None:
    ask = "import bigs._raster as r\ntry: r.simd_level()\nexcept ValueError as e: print(e)"
    environment = {**os.environ, "BIGS_RASTER_SIMD": "AVX2"}
    told = subprocess.run(
        [sys.executable, "-c", ask], env=environment, capture_output=True, text=True, check=True
    )
    assert told.stdout.startswith("BIGS_RASTER_SIMD: expected one of ")
    assert told.stdout.endswith(", found 'AVX2'\n") and "baseline" in told.stdout


def test_arrays_of_another_kind_are_told_by_name_and_dtype() -> None:
    inputs = arrays()
    mask = np.ones((16, 16), dtype=np.uint8)
    with pytest.raises(TypeError, match="pixel_mask: expected an array of bool, found uint8"):
        forward((*inputs[:8], mask))
    with pytest.raises(TypeError, match="quats: expected an array of float32, found float64"):
        forward((inputs[0], inputs[1].astype(np.float64), *inputs[2:]))
    with pytest.raises(TypeError, match=r"opacities: expected an array of float32, found .*list"):
        forward((*inputs[:3], [0.5] * 6, *inputs[4:]))


def test_leading_axes_fit_the_images() -> None:
    inputs = arrays()
    for lead in ((2,), (2**63, 2), (2**64 - 1,)):
        with pytest.raises(ValueError, match="lead: expected axes for 768 values"):
            _raster.rasterize_forward(inputs, SHARED, lead, 16, 16, RasterSettings(), "RGB", "pinhole")
    state = forward(inputs)[-1]
    with pytest.raises(ValueError, match="lead: expected axes for 256 values"):
        state.median_ids((2**64 - 1,), 16, 16)

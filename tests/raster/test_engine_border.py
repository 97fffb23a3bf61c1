"""The compiled engine itself, called as `bigs.raster` never would: errors, and no panic."""

import os
import subprocess
import sys
import threading

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


def test_any_byte_but_zero_is_true_in_a_mask() -> None:
    inputs = arrays()
    bits = np.random.default_rng(1).random((16, 16)) < 0.5
    for byte in (1, 2, 3, 254, 255):
        odd = (bits * np.uint8(byte)).view(bool)
        for plain, found in zip(
            forward((*inputs[:8], bits))[:5], forward((*inputs[:8], odd))[:5], strict=True
        ):
            assert np.array_equal(plain, found)
    dirs, coefficients = np.ones((2, 3), np.float32), np.ones((2, 1, 3), np.float32)
    two = np.array([2, 0], np.uint8).view(bool)
    assert _raster.harmonics_forward(0, (dirs, coefficients, two)).reshape(2, 3).any(1).tolist() == [
        True,
        False,
    ]


def test_arrays_at_odd_addresses_and_of_other_byte_orders_are_refused() -> None:
    inputs = arrays()
    for index, name in enumerate(("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")):
        changed = [*inputs]
        changed[index] = np.ndarray(
            inputs[index].shape, np.float32, b"\0" + inputs[index].tobytes(), offset=1
        )
        with pytest.raises(ValueError, match=f"{name}: expected an array aligned to its values"):
            forward(tuple(changed))
        changed[index] = inputs[index].astype(">f4")
        with pytest.raises(TypeError, match=f"{name}: expected an array of float"):
            forward(tuple(changed))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_is_told_and_does_not_wait() -> None:
    ask = (
        "import os, sys, numpy as np, bigs._raster as r\n"
        "def call(): r.harmonics_forward(0, (np.ones((1, 3)), np.ones((1, 1, 3)), None))\n"
        "call()\n"
        "child = os.fork()\n"
        "try: call()\n"
        "except RuntimeError as e: print(e, flush=True)\n"
        "if child == 0: os._exit(0)\n"
        "os.waitpid(child, 0)"
    )
    told = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", ask], capture_output=True, text=True, check=True, timeout=60
    )
    assert told.stdout.startswith(
        "the rasteriser: expected the process that began to compute, found one forked"
    )


@pytest.mark.skipif(sys.platform != "linux", reason="counts threads in /proc")
@pytest.mark.parametrize("first", ["main", "other"])
def test_the_main_thread_works_itself_and_others_share_a_pool(first: str) -> None:
    """Of three workers for the main thread it is one; threads that come and go are none."""
    ask = (
        "import os, threading, time, numpy as np, bigs._raster as r\n"
        "def call(): r.harmonics_forward(0, (np.ones((1, 3)), np.ones((1, 1, 3)), None))\n"
        "def elsewhere():\n"
        "    other = threading.Thread(target=call)\n"
        "    other.start()\n"
        "    other.join()\n"
        # It is still there for a moment.
        "    while os.path.exists(f'/proc/self/task/{other.native_id}'): time.sleep(0.001)\n"
        "count = lambda: len(os.listdir('/proc/self/task'))\n"
        "before = count()\n"
        f"for work in {'(call, call, elsewhere)' if first == 'main' else '(elsewhere, elsewhere, call)'}:\n"
        "    work()\n"
        "    print(count() - before)\n"
    )
    env = {**os.environ, "RAYON_NUM_THREADS": "3"}
    told = subprocess.run(
        [sys.executable, "-c", ask], env=env, capture_output=True, text=True, check=True, timeout=60
    )
    assert told.stdout.split() == (["2", "2", "5"] if first == "main" else ["3", "3", "5"])


def test_threads_share_the_engine() -> None:
    inputs = arrays(200)
    weights = np.random.default_rng(2).normal(size=(16, 16, 3)).astype(np.float32)

    def gradients(state: _raster.RasterState, gaussians: tuple) -> tuple:
        return _raster.rasterize_backward(state, gaussians[:5], SHARED[:5], weights, None, (True,) * 9)[:9]

    *images, shared = forward(inputs)
    expected = (*images, *gradients(shared, inputs))
    changing = [None if x is None else x.copy() for x in inputs]
    busy = [np.full_like(inputs[0], value) for value in (np.nan, 1e38, 0.0, 1.0)]
    found: list[object] = []

    def calls() -> None:
        for _ in range(20):
            *own, state = forward(inputs)
            results = (*own, *gradients(state, inputs))
            found.append(all(map(np.array_equal, results, expected)))
            found.append(all(map(np.array_equal, gradients(shared, inputs), expected[5:])))

    def change() -> None:
        for _ in range(200):
            for values in busy:
                changing[0][:] = values

    def render_what_changes() -> None:
        for _ in range(40):
            try:
                gradients(forward(tuple(changing))[-1], tuple(changing))
            except ValueError as error:
                found.append(str(error).startswith("means: expected finite values"))

    work = [calls, calls, calls, change, render_what_changes]
    threads = [threading.Thread(target=one) for one in work]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) >= 120 and all(found)

"""Values that no file should hold where something else belongs."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import numpy as np

# How deep lists are put into each other: what a careless reader can still follow, and what none can.
DEPTHS = (3, 40, 900, 30_000)


class Raw(str):
    """Text that a writer of JSON or YAML puts into the file as it is."""


def number(rng: random.Random) -> Any:
    """A number, or what a reader may take for one."""
    return rng.choice(
        (
            *(float("nan"), float("inf"), -float("inf"), 1e30, -1e30, 1e-30, -1e-30, 1e308, 5e-324),
            *(0, -0.0, 1, -1, 0.5, 2, 255, 256, 1e6, -1e6, 4096, 100_000),
            *(2**31, -(2**31) - 1, 2**53 + 1, 2**63, -(2**63) - 1, 2**64, 2**64 - 1),
            *(True, False, None),
        )
    )


def huge_integer(rng: random.Random) -> int:
    """An integer of 400 to 5000 digits."""
    digits = rng.choice((400, 1000, 4299, 4301, 5000))
    return rng.choice((1, -1)) * (10**digits - 1)


def text(rng: random.Random) -> str:
    """A name or a path that is none."""
    return rng.choice(
        (
            *("", " ", "x", ".", "..", "/", "a/b", "../../x", "/tmp/bigs-fuzzing-elsewhere/x"),
            *("x" * 300, "é" * 200, "x/" * 3000, "C:\\x", "NUL", "con.txt", "~", "-", "--help", "*"),
            *("nul\0byte", "\ud800", "a\nb", "a\rb", "\x1b[31mred", "\u202egnp.x", "\ufeffx", "𝕏"),
            *("nan", "1e999", "0x10", "1_000", "true", "null", "[]", "%s%n", "${HOME}", "{0}"),
            *("/dev/zero", "/dev/stdin", "/proc/self/mem", "9" * 5000, "[red]x[/red]", "[/]"),
        )
    )


def scalar(rng: random.Random) -> Any:
    return rng.choice((number, number, text))(rng)


def nested(rng: random.Random, depth: int, make: Callable[[Any], Any]) -> Any:
    value: Any = scalar(rng)
    for _ in range(depth):
        value = make(value)
    return value


def small_tree(rng: random.Random) -> Any:
    """A list or a dictionary, empty, ragged, of mixed kinds, or a little deep."""
    return rng.choice(
        (
            lambda: [],
            lambda: {},
            lambda: [[]],
            lambda: [[1.0, 2.0], [3.0]],
            lambda: [scalar(rng) for _ in range(rng.randrange(1, 6))],
            lambda: {text(rng): scalar(rng) for _ in range(rng.randrange(1, 4))},
            lambda: nested(rng, rng.choice(DEPTHS[:2]), lambda value: [value]),
            lambda: nested(rng, rng.choice(DEPTHS[:2]), lambda value: {"x": value}),
            lambda: [[number(rng)] * rng.randrange(5) for _ in range(rng.randrange(5))],
        )
    )()


def text_value(rng: random.Random) -> Any:
    """For files of text: what JSON can say, and what it can say only by force."""
    kind = rng.randrange(12)
    if kind < 6:
        return scalar(rng)
    if kind < 9:
        return small_tree(rng)
    if kind == 9:
        return Raw(
            str(10 ** rng.choice((400, 1000)) - 1)
            if rng.random() < 0.3
            else "9" * rng.choice((4299, 4301, 5000))
        )
    depth = rng.choice(DEPTHS)
    opening, closing = rng.choice((("[", "]"), ('{"a":', "}")))
    return Raw(opening * depth + "1" + closing * depth)


def python_value(rng: random.Random) -> Any:
    """For pickles: whatever Python has."""
    kind = rng.randrange(16)
    if kind < 5:
        return scalar(rng)
    if kind < 8:
        return small_tree(rng)
    if kind < 11:
        return array(rng)
    if kind == 11:
        return huge_integer(rng)
    if kind == 12:
        return nested(
            rng, rng.choice(DEPTHS[:3]) // 3, rng.choice((lambda v: [v], lambda v: {"x": v}, lambda v: (v,)))
        )
    if kind == 13:
        return shared(rng)
    return rng.choice(
        (
            b"bytes",
            bytearray(b"bytes"),
            complex(1, 2),
            {1, 2},
            frozenset((1, 2)),
            (1, 2),
            ((1, 2), (3,)),
            np.float64("nan"),
            np.float16(1),
            np.int8(-1),
            np.bool_(True),
            np.datetime64("2000-01-01"),
            np.str_("x"),
            {None: 1, 2: 3, ("a",): 4},
            Ellipsis,
        )
    )


def shared(rng: random.Random) -> Any:
    """A little that stands for very much: each level names the one below it several times."""
    make = rng.choice((lambda v: [v, v], lambda v: (v, v), lambda v: {"a": v, "b": v}, lambda v: [v] * 9))
    return nested(rng, rng.choice((6, 12, 28)), make)


def array(rng: random.Random) -> np.ndarray:
    """An array of any kind and shape."""
    shape = rng.choice(
        ((), (0,), (1,), (3,), (0, 3), (3, 3), (4, 4), (2, 3, 4), (1, 0, 5), (21, 3), (1,) * 20)
    )
    values = np.ones(shape)
    return rng.choice(
        (
            lambda: values,
            lambda: values * np.nan,
            lambda: values.astype(np.object_),
            lambda: values.astype(complex),
            lambda: values.astype(">f8"),
            lambda: values.astype(bool),
            lambda: values.astype(np.int64) * -1,
            lambda: values.astype("U5"),
            lambda: values.astype("S5"),
            lambda: values.astype("datetime64[s]"),
            lambda: np.zeros(shape, dtype=[("a", "f4"), ("b", "i8")]),
            lambda: np.array([None, "x", 3], dtype=np.object_),
            lambda: np.array(scalar(rng), dtype=np.object_),
        )
    )()


def changed_array(rng: random.Random, values: np.ndarray) -> Any:
    """An array that was right, and now is not."""
    values = np.array(values)
    changes: list[Callable[[], Any]] = [
        lambda: _with_entry(rng, values),
        lambda: _with_entry(rng, values),
        lambda: _with_entry(rng, values),
        lambda: _filled(rng, values),
        lambda: _scaled(rng, values),
        lambda: _scaled(rng, values),
        lambda: values.astype(rng.choice(_DTYPES)),
        lambda: values.astype(rng.choice(_DTYPES)),
        lambda: np.asfortranarray(values),
        lambda: values[..., ::-1],
        lambda: values.ravel(),
        lambda: values.T,
        lambda: values[None],
        lambda: values[..., None],
        lambda: values[:0],
        lambda: values[:-1],
        lambda: values[1:] if values.ndim else values,
        lambda: np.concatenate([values, values]),
        lambda: np.concatenate([values, values], axis=-1),
        lambda: values[..., :-1],
        lambda: values[0],
        lambda: np.array(values.ravel()[0]),
        lambda: values.tolist(),
        lambda: _ragged(values),
        lambda: np.roll(values, 1),
        lambda: rng_permuted(rng, values),
    ]
    for _ in range(8):
        try:
            with np.errstate(all="ignore"):
                return rng.choice(changes)()
        except (ValueError, TypeError, IndexError, OverflowError):
            continue  # a scalar has no rows, a text no multiple
    return array(rng)


_DTYPES = (
    "f2",
    "f4",
    ">f4",
    ">f8",
    "f8",
    "i1",
    "u1",
    "i8",
    "u8",
    ">i4",
    "?",
    "c16",
    "O",
    "U8",
    "S4",
    "m8[s]",
)


def _with_entry(rng: random.Random, values: np.ndarray) -> np.ndarray:
    flat = values.ravel().copy()
    flat[rng.randrange(len(flat))] = number(rng)
    return flat.reshape(values.shape)


def _filled(rng: random.Random, values: np.ndarray) -> np.ndarray:
    return np.full_like(values, number(rng))


def _scaled(rng: random.Random, values: np.ndarray) -> np.ndarray:
    factor = rng.choice((0.0, -1.0, 1e-30, 1e-6, 1e-3, 20.0, 1e3, 1e6, 1e12, 1e30, 1e200))
    return values * np.asarray(factor).astype(values.dtype)


def _ragged(values: np.ndarray) -> Any:
    rows = [row.tolist() for row in values]
    rows[-1] = rows[-1][:-1]
    if len(rows) % 2:
        return rows
    held = np.empty(len(rows), dtype=np.object_)
    held[:] = rows
    return held


def rng_permuted(rng: random.Random, values: np.ndarray) -> np.ndarray:
    order = list(range(len(values)))
    rng.shuffle(order)
    return values[order]

"""How many threads work takes, and work that needs no interpreter, side by side."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")


def limit_threads(threads: int) -> None:
    """Limit torch, what counts on `thread_count`, and the engine, which reads its variable on first use."""
    os.environ["RAYON_NUM_THREADS"] = str(threads)
    torch.set_num_threads(threads)


def thread_count() -> int:
    """How many threads work that is given to another library may take: as many as torch has."""
    return torch.get_num_threads()


def side_by_side(function: Callable[[T], R], items: Iterable[T], threads: int | None = None) -> list[R]:
    """`function` of each item, in their order, on some threads; None takes as many as torch has.

    It pays where most of the work is done without the interpreter: decoding, filtering, searching.
    """
    with ThreadPoolExecutor(threads or thread_count()) as pool:
        return list(pool.map(function, items))

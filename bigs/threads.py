"""Work that needs no interpreter, side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")


def side_by_side(function: Callable[[T], R], items: Iterable[T], threads: int | None = None) -> list[R]:
    """`function` of each item, in their order, on some threads; None takes as many as torch has.

    It pays where most of the work is done without the interpreter: decoding, filtering, searching.
    """
    with ThreadPoolExecutor(threads or torch.get_num_threads()) as pool:
        return list(pool.map(function, items))

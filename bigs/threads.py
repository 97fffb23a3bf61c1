"""How many threads work takes, and work that needs no interpreter, side by side."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

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


@contextmanager
def torch_alone() -> Iterator[None]:
    """In the block the caller's thread does torch's work alone.

    For many operations on little each: waking other threads would take longer than what they then do.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class _Caller(Executor):
    """Does its work where it is submitted."""

    def submit(self, function: Callable[..., R], /, *args: Any, **kwargs: Any) -> Future[R]:
        done: Future[R] = Future()
        try:
            done.set_result(function(*args, **kwargs))
        except Exception as error:  # whoever asks for the result gets it
            done.set_exception(error)
        return done


def beside(workers: int = 1) -> Executor:
    """Workers beside the caller; with one thread the caller does their work as it submits it."""
    return ThreadPoolExecutor(workers) if thread_count() > 1 else _Caller()


def side_by_side(function: Callable[[T], R], items: Iterable[T], threads: int | None = None) -> list[R]:
    """`function` of each item, in their order, on some threads; None takes as many as torch has.

    It pays where most of the work is done without the interpreter: decoding, filtering, searching.
    """
    with ThreadPoolExecutor(threads or thread_count()) as pool:
        return list(pool.map(function, items))

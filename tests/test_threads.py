"""Threads: no more than the caller allowed, and the same results with one."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import bigs
from bigs.threads import beside, side_by_side, thread_count, torch_alone
from bigs.train.loop.adam import FrameAdam


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_one_thread_does_everything_itself(threads: int) -> None:
    with beside() as pool:
        worker = pool.submit(threading.get_ident).result()
    assert (worker == threading.get_ident()) == (threads == 1)


def test_errors_wait_for_whoever_asks(threads: int) -> None:
    with beside() as pool:
        failed, fine = pool.submit(int, "three"), pool.submit(int, "3")
    assert fine.result() == 3
    with pytest.raises(ValueError, match="three"):
        failed.result()


def test_no_more_than_allowed_work_at_once(threads: int) -> None:
    if threads == 2:
        # Each of two waits until the other has begun.
        both = threading.Barrier(2, timeout=60)
        assert len(side_by_side(lambda _: both.wait(), range(2))) == 2
    workers = side_by_side(lambda _: threading.get_ident(), range(50))
    assert len(set(workers)) <= threads
    assert side_by_side(lambda x: x * x, range(50)) == [x * x for x in range(50)]


def test_nothing_else_makes_threads() -> None:
    """What made its own would ignore `--threads`."""
    root = Path(bigs.__file__).parent
    makers = [
        path.relative_to(root).as_posix()
        for path in root.rglob("*.py")
        if any(word in path.read_text() for word in ("ThreadPoolExecutor(", "workers=-1"))
    ]
    assert makers == ["threads.py"]


@pytest.mark.parametrize("fails", [False, True])
def test_torch_works_alone_in_the_block_only(fails: bool) -> None:
    before = thread_count()
    torch.set_num_threads(3)
    try:
        with contextlib.suppress(KeyError), torch_alone():
            assert thread_count() == 1
            if fails:
                raise KeyError
        assert thread_count() == 3
    finally:
        torch.set_num_threads(before)


def test_adam_wakes_no_other_thread(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    counts, fused = [], torch._fused_adam_

    def counted(*args: object, **options: object) -> None:
        counts.append(thread_count())
        fused(*args, **options)

    monkeypatch.setattr(torch, "_fused_adam_", counted)
    values = torch.nn.Parameter(torch.ones(3))
    values.grad = torch.ones(3)
    FrameAdam([{"params": [values], "lr": 0.1}]).step()
    assert counts == [1] and thread_count() == threads
    torch.testing.assert_close(values.detach(), torch.full((3,), 0.9))

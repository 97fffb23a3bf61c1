"""Work that a scene does not need: for each a task in which the engine can leave it out, and one without."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from bigs.bench.calls import Task


def _same(base: Task) -> Task:
    return base


@dataclass(frozen=True)
class Skip:
    """One thing that is left out."""

    label: str
    with_it: Callable[[Task], Task]
    without_it: Callable[[Task], Task] = _same
    work: float = (
        1.0  # how much more there was to leave out on the "with" side, as a factor on the time without
    )


SKIPS: tuple[Skip, ...] = (
    Skip("pixel mask, middle quarter", lambda base: replace(base, rendered="centre")),
    Skip("no gradient outside the middle quarter", lambda base: replace(base, differentiated="centre")),
    Skip("only gradients of colours", lambda base: replace(base, wanted=("colors",))),
    Skip(
        "stop at transmittance 1e-4",
        _same,
        lambda base: replace(base, settings=replace(base.settings, min_transmittance=0.0)),
    ),
    Skip(
        "8 cameras in one call",
        lambda base: replace(base, views=8),
        lambda base: replace(base, views=8, apart=True),
    ),
    # Without culling each Gaussian would cost what a seen one does; that can be computed but not switched on.
    Skip("as many Gaussians again, unseen", lambda base: replace(base, unseen=1.0), work=2.0),
)

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
    work: float = 1.0  # factor on the time without: how much more work the "with" side could skip


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
    # Culling cannot be switched off; its gain is computed as if each Gaussian cost as much as a seen one.
    Skip("as many Gaussians again, unseen", lambda base: replace(base, unseen=1.0), work=2.0),
)

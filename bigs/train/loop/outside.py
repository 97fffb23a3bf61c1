"""What is spared by pictures that end where hands and object never are."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from bigs.fused.outline import covered_shares
from bigs.fused.pixels import alone_terms, together_terms
from bigs.train.loop.step import Selection, Step
from bigs.train.loop.targets import Targets
from bigs.types import Gaussians

# A first call pays for memory that later ones find ready.
_TRIES = 2


def seconds_outside(step: Step) -> float:
    """Seconds that a finished step would have spent on pixels outside its targets' box, with their gradients.

    They are the share that lies outside of what whole pictures would cost that show nothing and are compared
    with nothing. This is measured on as many as the step made, and is the least that pixels could cost.
    """
    targets = step.evidence.targets
    whole = round(step.whole_size.prod().item() / targets.width)
    if whole <= targets.height:
        return 0.0
    outside = 1.0 - targets.height / whole
    return outside * sum(_seconds_of_nothing(step, whole, *picture) for picture in step.pictures)


def _seconds_of_nothing(step: Step, rows: int, views: int, channels: int) -> float:
    """Seconds of `views` pictures as wide as the box."""
    width = step.evidence.targets.width
    black = torch.zeros(views, rows, width)
    nowhere = Targets(black.new_zeros(*black.shape, 3), {}, black, step.evidence.targets.K, width, rows)
    frames = torch.arange(views)
    blank = Step(step.scene, replace(step.evidence, targets=nowhere), {}, Selection(frames))
    tries = []
    for _ in range(_TRIES):
        began = time.perf_counter()
        against = (nowhere.images, black, black)
        colors, alphas = _nothing(blank, views, channels)
        terms: Sequence[Tensor]
        if colors is not None and channels > 3:
            labels = [black] * (channels - 3)
            terms = together_terms(colors, alphas, *against, labels, frames, 1.0)
        else:
            terms = alone_terms(colors, alphas, *against, frames)
        torch.stack(list(terms)).sum().backward()
        tries.append(time.perf_counter() - began)
    return min(tries)


def _nothing(blank: Step, views: int, channels: int) -> tuple[Tensor | None, Tensor]:
    """Colours, if there are channels, and alphas of no Gaussians, or else of no mesh."""
    if channels == 0:
        targets, points = blank.evidence.targets, torch.zeros(views, 0, 3, requires_grad=True)
        no_faces = torch.zeros(0, 3, dtype=torch.long)
        return None, covered_shares(points, no_faces, targets.K, targets.width, targets.height)[..., None]
    means, quats, scales, opacities, colors = (
        torch.zeros(views, 0, *size, requires_grad=True) for size in ((3,), (4,), (3,), (), (channels,))
    )
    rendered = blank.render(Gaussians(means, quats, scales, opacities, colors))
    return rendered.colors, rendered.alphas

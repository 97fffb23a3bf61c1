"""From pictures to a clip: every step makes its artefact below `CLIP/processed` unless it is up to date."""

from __future__ import annotations

import time
from collections.abc import Callable

from bigs.commands.preprocess.object_steps import align_step, object_step
from bigs.commands.preprocess.request import STEPS, PreprocessRequest, StepName, StepOutcome
from bigs.commands.preprocess.steps import (
    build_step,
    check_mask_source,
    frames_step,
    hand_source,
    hands_step,
    masks_step,
)
from bigs.preprocess.frames.source import open_source

RUN: dict[StepName, Callable[[PreprocessRequest, Callable[[str], None]], StepOutcome]] = {
    "frames": frames_step,
    "masks": masks_step,
    "hands": hands_step,
    "object": object_step,
    "align": align_step,
    "build": build_step,
}


def preprocess(
    request: PreprocessRequest,
    steps: tuple[StepName, ...] = STEPS,
    listen: Callable[[str], None] = lambda text: None,
    tell: Callable[[StepOutcome], None] = lambda outcome: None,
) -> list[StepOutcome]:
    """Run steps in their order.

    Args:
        request: what the user gave.
        steps: which; each needs the artefacts of the ones before it.
        listen: told what is going on.
        tell: told what became of each step when it is done.

    Returns:
        What became of each step.

    Raises:
        InputError: bad input, in one sentence.
    """
    outcomes = []
    if len(steps) > 1:
        # What a later step lacks is said now, not after the minutes that earlier ones take.
        if "frames" in steps and request.source is not None:
            open_source(request.source)
        if "masks" in steps:
            check_mask_source(request)
        if "hands" in steps:
            hand_source(request)
    for name in STEPS:
        if name in steps:
            listen(name)
            began = time.perf_counter()
            outcome = RUN[name](request, _under_name(name, listen))
            outcomes.append(outcome._replace(seconds=time.perf_counter() - began))
            tell(outcomes[-1])
    return outcomes


def _under_name(name: str, listen: Callable[[str], None]) -> Callable[[str], None]:
    return lambda text: listen(f"{name}: {text}")

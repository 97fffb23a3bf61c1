"""The main job on a clip that the program makes itself: nothing to download, and the truth is known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from bigs.checks import InputError
from bigs.commands.reconstruct import Outcome, reconstruct
from bigs.data.synthetic import make_clip
from bigs.hand import load_hand_models
from bigs.train.config import RunConfig

CLIP = "clip"
RUN = "run"
_FRAMES = 24
_SIZE = (320, 240)


def demo(
    out: Path,
    config: RunConfig,
    *,
    seed: int = 0,
    listen: Callable[[dict[str, Any]], None] = lambda event: None,
) -> Outcome:
    """Make a clip with known truth in `out/clip`, reconstruct it into `out/run`, and score it.

    Raises:
        InputError: `out` holds an earlier demo.
    """
    for part in (CLIP, RUN):
        if (out / part).exists():
            raise InputError(f"{out / part}: expected an empty place for the demo, found an earlier one")
    listen({"event": "note", "stage": "demo", "text": "rendering a clip of two hands and a bottle"})
    width, height = _SIZE
    clip = make_clip(
        out / CLIP, hand_models=load_hand_models(None), frames=_FRAMES, width=width, height=height, seed=seed
    )
    return reconstruct(clip, out / RUN, config, ground_truth=clip / "gt.npz", listen=listen)

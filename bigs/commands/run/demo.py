"""Reconstruction of a generated clip with known truth: nothing to download."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from bigs.checks import InputError
from bigs.commands.folder.contents import CONFIG
from bigs.commands.run.reconstruct import Outcome, reconstruct
from bigs.data.synthetic import make_clip
from bigs.hand import load_hand_models
from bigs.train.loop.stopwatch import Stopwatch
from bigs.train.plan.config import RunConfig

CLIP = "clip"
_FRAMES = 24
_SIZE = (320, 240)


def demo(
    out: Path,
    config: RunConfig,
    *,
    seed: int = 0,
    listen: Callable[[dict[str, Any]], None] = lambda event: None,
) -> Outcome:
    """Make a clip with known truth in `out/clip`, reconstruct it into `out`, and score it.

    Raises:
        InputError: `out` holds something, such as an earlier demo.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a new or empty folder for the demo, found a file")
    if out.is_dir() and any(out.iterdir()):
        found = "an earlier demo" if (out / CLIP).is_dir() and (out / CONFIG).exists() else "other files"
        raise InputError(
            f"{out}: expected a new or empty folder for the demo, found {found}; remove it, or name another "
            "with --out"
        )
    watch = Stopwatch("making the clip")
    listen({"event": "note", "stage": "demo", "text": "rendering a clip of two hands and a bottle"})
    width, height = _SIZE
    clip = make_clip(
        out / CLIP, hand_models=load_hand_models(None), frames=_FRAMES, width=width, height=height, seed=seed
    )
    return reconstruct(clip, out, config, ground_truth=clip / "gt.npz", listen=listen, watch=watch)

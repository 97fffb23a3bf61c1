"""Commands on clips: convert."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from bigs.cli.terminal import ClipPath, say


def convert(
    clip: ClipPath,
    out: Path,
    view: Literal["full", "limited"] = "full",
    every: int = 1,
    fps: float | None = None,
    width: int = 0,
    masks: Path | None = None,
    from_truth: bool = False,
    hand_model: Path | None = None,
) -> None:
    """Write a clip of any layout, or some of its frames, as a HOLD / HANDS-challenge build folder.

    A data set's truth becomes gt.npz beside it.

    Args:
        clip: the clip, see bigs info.
        out: folder to make.
        view: full, or the paper's limited view: a quarter of the frames that shows the object from few sides.
        every: keep every Nth frame.
        fps: frames a second of the clip; by default what its files or its frames' numbers say.
        width: width of the images; 0 keeps theirs.
        masks: folder of label masks (0, 50 object, 150 right, 250 left) named like the images; the clip's own
            by default.
        from_truth: start from a data set's ground truth, to study what follows it; not a fair start.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
    """
    from bigs.commands.clips.convert import ConvertPlan
    from bigs.commands.clips.convert import convert as run

    for name, text in run(clip, out, ConvertPlan(view, every, fps, width, masks, from_truth), hand_model):
        say(f"{name:10s} {text}")

"""Reconstruct a clip of the ARCTIC challenge and write its submission file.

Key ideas:
- A clip is a HOLD / HANDS-challenge `build` folder: images, label masks, and initial estimates in `data.npy`.
- A run is one call with a configuration that is a plain value; presets are such values.
- `arctic_preds/<sequence>.pt` is the challenge's file. It can be read back and scored without the run.

Without a clip a small one is made by code, with its truth, and reconstructed with the `smoke` preset.

    python examples/reconstruct_arctic.py --out OUT
    python examples/reconstruct_arctic.py --clip CLIP --hand-model DIR --preset full --out OUT
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

from bigs.commands.reconstruct import reconstruct
from bigs.data.ground_truth import load_ground_truth
from bigs.data.hold import load_hold
from bigs.data.synthetic import make_clip
from bigs.export.challenge import load_challenge, validate_challenge
from bigs.hand import load_hand_models
from bigs.metrics.report import comparison_table, evaluate
from bigs.train.initial import initial_trajectory
from bigs.train.presets import PRESETS


def main(
    out: Path = Path("example_out/arctic"),
    clip: Path | None = None,
    hand_model: Path | None = None,
    gt: Path | None = None,
    preset: Literal["smoke", "fast", "full", "paper"] = "smoke",
    frames: int = 24,
) -> Path:
    """Reconstruct a clip, check the submission file, and score it where the truth is known.

    Args:
        out: folder to make; must not hold an earlier run.
        clip: a `build` folder, or the folder that holds it; without it one is made by code.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl), which the challenge's clips need.
        gt: `gt.npz` of the clip, where there is one.
        preset: how much work to put in.
        frames: length of the clip that is made by code.
    """
    if clip is None:
        models = load_hand_models(hand_model)
        clip = make_clip(out / "clip", hand_models=models, frames=frames, width=160, height=120, seed=0)
        gt = clip / "gt.npz"
    outcome = reconstruct(clip, out / "run", PRESETS[preset], hand_model=hand_model)

    loaded = load_hold(clip)
    submission = outcome.run / "arctic_preds" / f"{loaded.name}.pt"
    validate_challenge(submission)
    print(f"{submission} is complete: {len(loaded)} frames")
    if gt is not None:
        truth = load_ground_truth(gt)
        # What is scored is what would be sent in: read back from the file, in half precision. It numbers its
        # frames; the clip knows their names.
        predicted = load_challenge(submission, loaded.frame_names)
        before = initial_trajectory(loaded, load_hand_models(hand_model))
        scores = {"initial": evaluate(before, truth), "submission": evaluate(predicted, truth)}
        for score, unit, *values in comparison_table(scores):
            print(f"{score:26s} {unit:5s}" + "".join(f"{value:>14s}" for value in values))
    return submission


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)

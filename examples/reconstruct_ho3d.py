"""Reconstruct clips of HO-3D, in full view or in the paper's limited view, and score them beside its Table 2.

Key ideas:
- HO-3D's own folder has images and truth; a run starts from HOLD's `build` folders, which have masks and
  estimates. Both name their frames alike, so either finds its place.
- The limited view keeps the quarter of the frames that see the object from the fewest sides.
- Poses of HO-3D are absolute and its camera has OpenGL axes; the loader turns both, once.

Without data a small clip of one hand is generated and written as both lay it out.

    python examples/reconstruct_ho3d.py --out OUT
    python examples/reconstruct_ho3d.py --data HOLD --truth HO3D --clips SM1 MPM10 --view limited \\
        --hand-model MANO --preset full --out OUT
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro

from bigs.checks import InputError
from bigs.commands.clips.convert import ConvertPlan, convert
from bigs.commands.evaluate.runs import MADE_BY_CODE, EvaluationPlan, compare_runs, evaluate_run
from bigs.commands.run.reconstruct import reconstruct
from bigs.data.formats.ho3d import CV_FROM_GL
from bigs.data.formats.hold import load_hold
from bigs.data.formats.writers import write_ho3d
from bigs.data.ground_truth import load_annotation
from bigs.data.moving import in_world
from bigs.data.synthetic import make_clip
from bigs.hand import load_hand_models
from bigs.train.plan.presets import PRESETS

STAND_IN = "SYN1"


def main(
    out: Path = Path("example_out/ho3d"),
    data: Path | None = None,
    truth: Path | None = None,
    clips: tuple[str, ...] = ("SM1",),
    view: Literal["full", "limited"] = "full",
    hand_model: Path | None = None,
    preset: Literal["smoke", "fast", "full", "paper"] = "smoke",
    frames: int = 16,
) -> dict[str, float]:
    """Reconstruct each clip, score it, and write the table.

    Args:
        out: folder to make: clips, a run for each, the table of scores. Finished runs are kept.
        data: HOLD's folders hold_CLIP_ho3d/build; without it a clip is generated.
        truth: HO-3D's release, with the YCB models in models/.
        clips: names of clips, as HO-3D has them.
        view: full, or the paper's limited view.
        hand_model: folder with MANO_RIGHT (.npz or .pkl), which HO-3D's poses need.
        preset: how much work to put in.
        frames: length of the clip that is generated.

    Returns:
        The scores of the last clip.
    """
    if data is None:
        data = truth = stand_in(out / "data", frames)
        clips = (STAND_IN,)
    if truth is None:
        raise InputError("--truth: expected HO-3D's release to score against, found none given")
    scores = {}
    for name in clips:
        clip, run = out / "clips" / f"{name}_{view}", out / f"{name}_{view}"
        if not clip.exists():
            for what, text in convert(
                data / f"hold_{name}_ho3d", clip, ConvertPlan(view=view), hand_model=hand_model
            ):
                print(f"{what:10s} {text}")
        if not (run / "scene.safetensors").exists():
            resume = (run / "config.yaml").exists()
            reconstruct(clip, run, PRESETS[preset], hand_model=hand_model, resume=resume)
        found = [split for split in ("train", "evaluation") if (truth / split / name).is_dir()]
        if not found:
            raise InputError(f"{truth}: expected train/{name} or evaluation/{name}, found neither")
        scores[run.name] = evaluate_run(run, EvaluationPlan(ground_truth=truth / found[0] / name))
    for table in compare_runs(scores, out):
        print(f"\n{table.title}")
        for first, *rest in table.rows:
            print(f"{first:40s}" + "".join(f"{cell:>12s}" for cell in rest))
    return scores[run.name].scores["result"]


def stand_in(folder: Path, frames: int) -> Path:
    """A synthetic clip of a right hand as HOLD has it and, beside it, as HO-3D has it."""
    clip = folder / f"hold_{STAND_IN}_ho3d"
    if clip.exists():
        return folder
    models = load_hand_models(None)
    make_clip(
        clip, hand_models=models, frames=frames, width=160, height=120, hands=("right",), name=clip.name
    )
    loaded, annotation = load_hold(clip), load_annotation(clip)
    betas = torch.as_tensor(annotation.hands["right"].betas, dtype=torch.float32)
    wrist = models["right"].rest_joints(betas)[0].double().numpy()
    write_ho3d(
        folder,
        in_world(annotation, CV_FROM_GL, {"right": wrist}),
        clip=STAND_IN,
        object_name="bottle",
        images=[loaded.image(t) for t in range(frames)],
        hands_mean=np.asarray(models["right"].hands_mean),
    )
    # HO-3D numbers its frames from 0 with four digits; the clip shall call them the same.
    names = "".join(f"{t:04d}.jpg\n" for t in range(frames))
    (clip / "build" / "corres.txt").write_text(names)
    (folder / MADE_BY_CODE).write_text("Everything below was generated: no clip of the data set.\n")
    return folder


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)

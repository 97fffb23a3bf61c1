"""Reconstruct sequences of ARCTIC and write the challenge's submission.

Key ideas:
- A run starts from estimates. The HANDS challenge's download has them: a `build` folder for each sequence.
  From ARCTIC's own download they are made first, from its images, label masks and 2-D keypoints of the hands.
- ARCTIC's annotation only scores: `--truth` names the folder that holds raw_seqs/ and meta/.
- `arctic_preds.zip` is written when every sequence is done, and checked as the server reads it.

Without data a small sequence is generated and written as the challenge and as ARCTIC lay it out.

    python examples/reconstruct_arctic.py --out OUT
    python examples/reconstruct_arctic.py --data HANDS --hand-model MANO --preset full --out OUT
    python examples/reconstruct_arctic.py --data ARCTIC --masks MASKS --keypoints KEYPOINTS \\
        --sequences arctic_s05_box_grab_01_1 --truth ARCTIC --hand-model MANO --preset full --out OUT
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import tyro

from bigs.checks import InputError
from bigs.commands.evaluate.runs import MADE_BY_CODE, EvaluationPlan, compare_runs, evaluate_run
from bigs.commands.export.submission import submit
from bigs.commands.preprocess.all_steps import preprocess
from bigs.commands.preprocess.request import PreprocessRequest
from bigs.commands.run.reconstruct import reconstruct
from bigs.data.formats.arctic import find_arctic, read_arctic
from bigs.data.formats.hold import load_hold
from bigs.data.formats.writers import write_arctic
from bigs.data.ground_truth import load_annotation
from bigs.data.images import IMAGE_SUFFIXES, list_frames
from bigs.data.synthetic import make_clip
from bigs.export.submission import TEST_SEQUENCES
from bigs.hand import load_hand_models
from bigs.preprocess.frames.camera import CameraRequest
from bigs.preprocess.frames.extract import FrameConfig
from bigs.train.plan.presets import PRESETS

STAND_IN = "arctic_s99_bottle_grab_01_1"


def main(
    out: Path = Path("example_out/arctic"),
    data: Path | None = None,
    truth: Path | None = None,
    masks: Path | None = None,
    keypoints: Path | None = None,
    sequences: tuple[str, ...] = TEST_SEQUENCES,
    hand_model: Path | None = None,
    preset: Literal["smoke", "fast", "full", "paper"] = "smoke",
    frames: int = 16,
) -> Path:
    """Reconstruct each sequence, score it where the truth is known, and pack the submission.

    Args:
        out: folder to make: a run for each sequence, the table of scores, the zip. Finished runs are kept.
        data: the challenge's folders SEQUENCE/build, or ARCTIC's release; without it a sequence is made.
        truth: ARCTIC's release, to score against; it has no truth of subject 3.
        masks: folder with SEQUENCE/ of label masks, for ARCTIC's own images.
        keypoints: folder with SEQUENCE.json of 2-D keypoints, for ARCTIC's own images.
        sequences: names as the challenge has them; the nine of subject 3 and camera 1 if not given.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl), which ARCTIC's poses need.
        preset: how much work to put in.
        frames: length of the sequence that is generated.

    Returns:
        The zip.
    """
    if data is None:
        data = truth = stand_in(out / "data", frames)
        sequences = (STAND_IN,)
    runs = {}
    for name in sequences:
        runs[name] = out / name
        if not (runs[name] / "scene.safetensors").exists():
            clip = find_clip(data, name, out / "clips" / name, masks, keypoints, hand_model)
            # A run that was interrupted goes on.
            resume = (runs[name] / "config.yaml").exists()
            reconstruct(clip, runs[name], PRESETS[preset], hand_model=hand_model, resume=resume)
        print(f"{name}: {runs[name]}")
    if truth is not None:
        plans = {name: EvaluationPlan(ground_truth=truth / path_of(name)) for name in sequences}
        scores = {name: evaluate_run(runs[name], plan) for name, plan in plans.items()}
        for table in compare_runs(scores, out):
            print(f"\n{table.title}")
            for first, *rest in table.rows:
                print(f"{first:56s}" + "".join(f"{cell:>12s}" for cell in rest))
    archive = out / "arctic_preds.zip"
    for sequence, length, _ in submit(archive, list(runs.values()), sequences)[1:]:
        print(f"{sequence}: {length} frames submitted")
    return archive


def path_of(name: str) -> Path:
    """SUBJECT/SEQUENCE/VIEW of a sequence by the challenge's name."""
    parts = re.fullmatch(r"arctic_(s\d+)_(.+)_(\d)", name)
    if parts is None:
        raise InputError(f"--sequences: expected names as arctic_s05_box_grab_01_1, found {name}")
    return Path(*parts.groups())


def find_clip(
    data: Path, name: str, made: Path, masks: Path | None, keypoints: Path | None, hand_model: Path | None
) -> Path:
    """The sequence's clip: the challenge's, or one that is made from ARCTIC's images."""
    if (data / name).is_dir():
        return data / name
    view = find_arctic(data / path_of(name))
    if view is None or masks is None or keypoints is None:
        raise InputError(
            f"{data / name}: expected the challenge's clip, or ARCTIC's release with --masks and "
            "--keypoints, found neither"
        )
    images = view.frames_in("images")
    names = [file.name for file in list_frames(images, IMAGE_SUFFIXES)]
    K = read_arctic(view, names).K
    camera = CameraRequest(K=(K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    request = PreprocessRequest(
        clip=made,
        source=images,
        frames=FrameConfig(camera=camera),
        masks=masks / name,
        keypoints=keypoints / f"{name}.json",
        hand_model=hand_model,
    )
    for step in preprocess(request):
        print(f"{step.name:7s} {step.state}: {step.summary}")
    return made


def stand_in(folder: Path, frames: int) -> Path:
    """A synthetic sequence as the challenge's folder and, beside it, with its truth as ARCTIC has it."""
    if (folder / STAND_IN).exists():
        return folder
    models = load_hand_models(None)
    clip = make_clip(
        folder / STAND_IN, hand_models=models, frames=frames, width=160, height=120, name=STAND_IN
    )
    loaded = load_hold(clip)
    images = [loaded.image(t) for t in range(frames)]
    annotation = load_annotation(clip)
    write_arctic(folder, annotation, subject="s99", sequence="bottle_grab_01", images=images, offset=0)
    (folder / MADE_BY_CODE).write_text("Everything below was generated: no clip of the data set.\n")
    return folder


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)

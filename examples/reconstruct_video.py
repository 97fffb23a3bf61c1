"""From a video to a reconstruction, scored where the truth is known.

Key ideas:
- A run starts from a clip: frames, label masks, a camera, and estimates of hands and object. `preprocess`
  makes it from a video, your masks and 2-D keypoints of the hands, step by step, each step kept.
- What a step left is used again as long as its inputs are the same; another tool may supply it.
- `bigs reconstruct video.mp4 --masks DIR --keypoints FILE --focal F --out RUN` does the same.

Without a video one is generated, with masks, keypoints that err by a pixel, and its truth.

    python examples/reconstruct_video.py --out OUT
    python examples/reconstruct_video.py --video video.mp4 --masks MASKS --keypoints keypoints.json \\
        --focal 1450 --hand-model MANO --preset full --out OUT
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import tyro

from bigs.checks import InputError
from bigs.commands.evaluate.runs import EvaluationPlan, evaluate_run
from bigs.commands.preprocess.all_steps import preprocess
from bigs.commands.preprocess.request import PreprocessRequest
from bigs.commands.run.reconstruct import reconstruct
from bigs.data.formats.hold import load_hold
from bigs.data.ground_truth import load_ground_truth
from bigs.data.synthetic import make_clip
from bigs.hand import load_hand_models
from bigs.preprocess.frames.camera import CameraRequest
from bigs.preprocess.frames.extract import FrameConfig
from bigs.train.plan.presets import PRESETS

# Pixels by which the made keypoints err.
NOISE = 1.0


class Footage(NamedTuple):
    """What a user has."""

    video: Path  # or a folder of images
    masks: Path
    keypoints: Path
    camera: CameraRequest


def main(
    out: Path = Path("example_out/video"),
    video: Path | None = None,
    masks: Path | None = None,
    keypoints: Path | None = None,
    focal: float | None = None,
    hand_model: Path | None = None,
    preset: Literal["smoke", "fast", "full", "paper"] = "smoke",
    frames: int = 20,
) -> Path:
    """Make a clip of a video and reconstruct it.

    Args:
        out: folder to make: the clip with what each step left, and the run.
        video: a video, or a folder of images; without it one is generated.
        masks: folder of label masks (0, 50 object, 150 right, 250 left), one for each frame.
        keypoints: JSON file of 21 keypoints of each hand in each frame.
        focal: focal length in pixels; from the file or assumed if not given.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        preset: how much work to put in.
        frames: length of the video that is generated.

    Returns:
        The run.
    """
    truth = None
    if video is None:
        truth = out / "made"
        footage = make_footage(truth, frames)
    elif masks is None or keypoints is None:
        raise InputError(f"{video}: expected --masks and --keypoints with a video, found not both")
    else:
        footage = Footage(video, masks, keypoints, CameraRequest(focal=focal))
    request = PreprocessRequest(
        clip=out / "clip",
        source=footage.video,
        frames=FrameConfig(camera=footage.camera),
        masks=footage.masks,
        keypoints=footage.keypoints,
        hand_model=hand_model,
    )
    for step in preprocess(request):
        print(f"{step.name:7s} {step.state}: {step.summary}")
    run = out / "run"
    if not (run / "scene.safetensors").exists():
        resume = (run / "config.yaml").exists()
        reconstruct(out / "clip", run, PRESETS[preset], hand_model=hand_model, resume=resume)
    if truth is not None:
        scores = evaluate_run(run, EvaluationPlan(ground_truth=truth))
        for score, unit, *values in scores.table()[1:]:
            print(f"{score:42s} {unit:5s}" + "".join(f"{value:>14s}" for value in values))
    print(f"see {run / 'report.html'}")
    return run


def make_footage(folder: Path, frames: int) -> Footage:
    """A synthetic clip as what a user has: pictures, masks and keypoints, and its camera."""
    if not folder.exists():
        make_clip(folder, hand_models=load_hand_models(None), frames=frames, width=320, height=240)
        # The truth calls its frames what the folder of pictures will call them.
        names = "".join(f"{t:04d}.png\n" for t in range(frames))
        (folder / "build" / "corres.txt").write_text(names)
    clip, truth = load_hold(folder), load_ground_truth(folder)
    rng = np.random.default_rng(0)
    rows: list[dict[str, list[list[float]]]] = [{} for _ in range(len(clip))]
    for side, joints in truth.joints.items():
        pixels = joints @ clip.K.T
        points = pixels[..., :2] / pixels[..., 2:]
        points += NOISE * rng.standard_normal(points.shape)
        for row, found in zip(rows, points, strict=True):
            row[side] = [[float(x), float(y), 1.0] for x, y in found]
    keypoints = folder / "keypoints.json"
    keypoints.write_text(json.dumps({"order": "mano", "frames": rows}))
    K = clip.K
    camera = CameraRequest(K=(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])))
    return Footage(folder / "build" / "image", folder / "build" / "mask", keypoints, camera)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)

"""Let a reconstruction play another clip's motion, seen from another camera.

Key ideas:
- A finished run is plain tensors (`load_run`): no clip and no hand model is needed to pose it again.
- Gaussians of a hand ride on its skeleton, so any rotations of its joints will do: `repose`.
- The other clip's hands are used where they are; its object's motion is used relative to its first frame,
  since every reconstruction has an object frame of its own.

Writes the pictures `%04d.png` (white behind the scene) and `strip.png`, which shows some of them: the run as
it was above, the run in the new motion below.

Without a run two small clips are generated and the first is reconstructed with the `smoke` preset.

    python examples/novel_pose.py --out OUT
    python examples/novel_pose.py --run RUN --motion CLIP --hand-model MANO --degrees 60 --out OUT
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

from bigs.checks import InputError
from bigs.commands.clips.open import open_clip
from bigs.commands.folder.contents import load_run
from bigs.commands.render.frame import orbit_camera, render_frame
from bigs.commands.run.reconstruct import reconstruct
from bigs.data.base import Clip
from bigs.data.excerpt import excerpt, to_and_fro
from bigs.data.synthetic import make_clip
from bigs.hand import HandModel, load_hand_models, mirror_points
from bigs.models.playback import HandPlayback, Playback
from bigs.models.repose import repose
from bigs.train.plan.presets import PRESETS
from bigs.train.plan.start_config import InitialConfig
from bigs.train.start.initial import hand_in_camera, object_in_camera, smooth_hand, smooth_object
from bigs.types import Side

SHOWN = 5


def main(
    out: Path = Path("example_out/novel_pose"),
    run: Path | None = None,
    motion: Path | None = None,
    hand_model: Path | None = None,
    degrees: float = 30.0,
    frames: int = 12,
) -> Playback:
    """Render a run in another clip's motion.

    Args:
        out: folder for the pictures.
        run: a finished run; without it one is made.
        motion: a clip of any layout, whose hands and object move; without it one is made.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl) that the clip's poses belong to.
        degrees: by how much the camera is turned about the scene.
        frames: length of the clips that are generated.

    Returns:
        The run in its new poses.
    """
    models = load_hand_models(hand_model)
    if run is None:
        run = out / "run"
        if not (run / "scene.safetensors").exists():
            clip = make_clip(out / "clip", hand_models=models, frames=frames, width=160, height=120)
            reconstruct(clip, run, PRESETS["smoke"], hand_model=hand_model)
    if motion is None:
        motion = out / "motion"
        if not motion.exists():
            make_clip(motion, hand_models=models, frames=frames, width=160, height=120, object="box", seed=5)
    before = load_run(run)
    after = driven(before, open_clip(motion, models), models)

    rows: dict[str, list[Image.Image]] = {"before": [], "after": []}
    for t in range(len(after)):
        for name, playback in (("before", before), ("after", after)):
            viewmat = orbit_camera(playback, t, degrees)
            color, alpha = render_frame(playback, t, viewmat, playback.K, playback.width, playback.height)
            white = np.clip(color + 1.0 - alpha[..., None], 0.0, 1.0)
            rows[name].append(Image.fromarray((255 * white).round().astype(np.uint8)))
        rows["after"][-1].save(out / f"{t:04d}.png")
    strip(rows).save(out / "strip.png")
    print(f"{len(after)} pictures in {out}")
    return after


def driven(playback: Playback, clip: Clip, models: Mapping[Side, HandModel]) -> Playback:
    """The run with the clip's hands and object motion; the clip goes to and fro if it is shorter."""
    clip = excerpt(clip, to_and_fro(len(clip), len(playback)))
    config = InitialConfig()
    hands = {}
    for side, hand in playback.hands.items():
        if side not in clip.hands:
            raise InputError(f"{clip.folder}: expected a {side} hand to follow, found none")
        hands[side] = follow_hand(hand, side, clip, models[side], config)
    obj = playback.object
    if obj is not None and clip.object is not None:
        track = smooth_object(object_in_camera(clip, config), config.smooth_object)
        turns = track.rotations @ track.rotations[0].T
        obj = replace(obj, rotations=turns @ obj.rotations[0], centers=track.centers)
    return replace(playback, hands=hands, object=obj)


def follow_hand(
    hand: HandPlayback, side: Side, clip: Clip, model: HandModel, config: InitialConfig
) -> HandPlayback:
    """The hand in the clip's poses, smoothed as a reconstruction would smooth them."""
    start = hand_in_camera(clip.hands[side], clip.cam_from_world, model, config)
    start = smooth_hand(start, config.smooth_hands)
    # Rotations of a left hand are a right hand's already; its wrist is still where it truly is.
    wrist = mirror_points(start.wrist) if side == "left" else start.wrist
    return repose(hand, side, start.hand_pose, start.global_orient, wrist)


def strip(rows: Mapping[str, list[Image.Image]]) -> Image.Image:
    """Some pictures of each row, side by side."""
    width, height = next(iter(rows.values()))[0].size
    count = len(next(iter(rows.values())))
    chosen = np.linspace(0, count - 1, min(SHOWN, count)).round().astype(int)
    sheet = Image.new("RGB", (width * len(chosen), height * len(rows)))
    for row, pictures in enumerate(rows.values()):
        for column, t in enumerate(chosen):
            sheet.paste(pictures[t], (column * width, row * height))
    return sheet


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)

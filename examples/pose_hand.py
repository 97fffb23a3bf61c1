"""Pose the built-in hand and render both hands from one set of Gaussians.

Key ideas:
- The built-in hand needs no file. `load_hand_models(DIR)` reads MANO-format files; nothing else changes.
- A hand is posed by rotations: 15 finger joints relative to their parents, one for the wrist.
- There is one canonical hand, the right one. The left hand is its mirror image, so the same Gaussians and
  the same poses show a pair of hands that close together.

Writes `hands.png` (four stages of a fist) and `right_fist.ply` (the posed mesh, metres).

    python examples/pose_hand.py --out OUT
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from bigs.export.mesh import save_mesh
from bigs.hand import HandModel, load_hand_models
from bigs.models.hand_splats import HandSplats, HandSplatsConfig, rest_points
from bigs.models.poses import HandFrames
from bigs.models.posing import hand_part, pose_parts
from bigs.raster import rasterization
from bigs.viewer.preview import contact_sheet, save_picture

# Camera axes of the model's: fingers (-x) up, palm (-y) to the camera, thumb (+z) inwards.
UPRIGHT = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def main(
    out: Path = Path("example_out"),
    hand_model: Path | None = None,
    width: int = 320,
    height: int = 240,
) -> None:
    """Close both hands to fists.

    Args:
        out: folder for the picture and the mesh.
        hand_model: folder with MANO_RIGHT (.npz or .pkl); without it the built-in hand is used.
        width: of a picture, pixels.
        height: of a picture, pixels.
    """
    torch.manual_seed(0)
    right = load_hand_models(hand_model)["right"]
    stages = torch.linspace(0.0, 1.0, 4)
    frames = HandFrames(
        global_orient=UPRIGHT.expand(len(stages), 3, 3),
        hand_pose=fist(right, stages),
        wrist=torch.tensor([-0.1, 0.08, 0.5]).expand(len(stages), 3),
    )
    betas = torch.zeros(10)

    with torch.no_grad():
        # The fields are fresh, so they reproduce the template; trained ones are used in the same way.
        canonical = HandSplats(right, HandSplatsConfig())()
        bones = right.skeleton(betas, frames.hand_pose, frames.global_orient, frames.wrist).bone_transforms
        points = rest_points(canonical, betas, frames.hand_pose)
        pair = [hand_part(canonical, points, bones, side) for side in ("right", "left")]
        no_parts, no_shade = torch.zeros(len(canonical.points), 0), torch.zeros(len(stages), 4)
        lit = pose_parts((part.lit(no_parts, no_shade) for part in pair), from_above())
        K = torch.tensor([[1.1 * width, 0.0, width / 2], [0.0, 1.1 * width, height / 2], [0.0, 0.0, 1.0]])
        colors, _, _ = rasterization(
            *lit, torch.eye(4)[None], K[None], width, height, backgrounds=torch.full((1, 3), 0.92)
        )
        posed = right(betas, frames.hand_pose, frames.global_orient, frames.wrist)

    out.mkdir(parents=True, exist_ok=True)
    captions = [f"{100 * float(stage):.0f} % closed" for stage in stages]
    save_picture(out / "hands.png", contact_sheet({"hands": list(colors[:, 0].numpy())}, captions))
    save_mesh(out / "right_fist.ply", posed.vertices[-1].numpy(), right.faces.numpy())
    moved = np.linalg.norm((posed.joints[-1] - posed.joints[0])[17:].numpy(), axis=-1)
    print(f"fingertips move {100 * moved.mean():.1f} cm; picture and mesh in {out}")


def fist(model: HandModel, amount: Tensor) -> Tensor:
    """Finger rotations [T, 15, 3, 3] that close a right hand by `amount` [T], from 0 (flat) to 1.

    In MANO's axes the fingers point to -x and the palm to -y, so a finger bends about +z.
    """
    bend = torch.zeros(len(amount), 15, 3)
    knuckle, middle, tip = math.radians(85), math.radians(105), math.radians(75)
    bend[:, :12, 2] = torch.tensor([knuckle, middle, tip]).repeat(4) * amount[:, None]
    bend[:, 12, 0] = math.radians(45) * amount  # the thumb turns in front of the palm
    bend[:, 13:, :2] = math.radians(30) * amount[:, None, None] * torch.tensor([0.8, -0.6])
    return model.pose_matrices(bend - model.hands_mean)


def from_above() -> Tensor:
    """Coefficients [8, 3] of a light above the camera, for `bigs.models.lighting.light`."""
    coefficients = torch.zeros(8, 3)
    coefficients[1] = -0.35  # y points down
    coefficients[2] = -0.45  # z points away
    return coefficients


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)

"""The object's size from contact: the one size at which hands that touch it in the image touch it in space."""

from __future__ import annotations

import torch
from torch import Tensor

from bigs.losses.contact import nearest_mean
from bigs.models.scene import Scene
from bigs.train.config import ScaleSearchStage
from bigs.types import Side


@torch.no_grad()
def search_object_scale(
    scene: Scene, stage: ScaleSearchStage, touching: dict[Side, Tensor]
) -> tuple[float, Tensor, Tensor]:
    """Set the object's scale, which leaves its projection alone, to where the hands touch its surface best.

    The cost of a frame is d / (d + 10 mm) of the mean distance d of the hand's 30 nearest vertices: frames in
    which a pose is wrong saturate instead of pulling.

    Returns:
        The chosen factor on the present scale, the factors tried [C] and their costs [C]. The scene is left
        as it was when no frame touches.
    """
    factors = torch.linspace(1.0 - stage.span, 1.0 + stage.span, stage.candidates)
    start = scene.object_poses.log_scale.clone()
    frames = torch.arange(scene.n_frames)
    hands = {side: scene.hand_points(side, frames)[0] for side in scene.sides}
    costs = torch.zeros(len(factors))
    for c, factor in enumerate(factors):
        scene.object_poses.log_scale.copy_(start + factor.log())
        scale = scene.object_poses.log_scale.exp()
        for side, verts in hands.items():
            distances = scale * scene.object_distance(scene.in_object_frame(verts, frames))
            nearest = nearest_mean(distances, 30)
            costs[c] += (nearest / (nearest + 0.01) * touching[side]).sum()
    total = sum(float(t.sum()) for t in touching.values())
    if total == 0.0:
        scene.object_poses.log_scale.copy_(start)
        return 1.0, factors, costs
    best = factors[costs.argmin()]
    scene.object_poses.log_scale.copy_(start + best.log())
    return float(best), factors, costs / total

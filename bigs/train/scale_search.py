"""The object's size from contact: at which size do hands that touch it in the image touch it in space?"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from bigs.losses.contact import surface_contact
from bigs.models.scene import Scene
from bigs.train.config import ScaleSearchStage
from bigs.types import Side


@torch.no_grad()
def search_object_scale(
    scene: Scene,
    stage: ScaleSearchStage,
    touching: dict[Side, Tensor],
    occlusion: Callable[[], float] = lambda: 0.0,
) -> tuple[float, Tensor, Tensor]:
    """Set the object's scale, which leaves its projection alone, to where the hands touch its surface best.

    The cost is the contact term's own plus `stage.labels_weight` times `occlusion()`: how badly the scene as
    it is agrees with what hides what in the images.

    Returns:
        The chosen factor on the present scale, the factors tried [C] and their costs [C]. The scene is left
        as it was when no frame touches.
    """
    factors = torch.linspace(1.0 - stage.span, 1.0 + stage.span, stage.candidates)
    start = scene.object_poses.log_scale.clone()
    frames = torch.arange(scene.n_frames)
    hands = {side: scene.at(frames).verts(side) for side in scene.sides}
    costs = torch.zeros(len(factors))
    for c, factor in enumerate(factors):
        scene.object_poses.log_scale.copy_(start + factor.log())
        scale = scene.object_poses.log_scale.exp()
        for side, verts in hands.items():
            distances = scale * scene.object_distance(scene.at(frames).in_object_frame(verts))
            costs[c] += surface_contact(distances, touching[side]) / len(hands)
        costs[c] += stage.labels_weight * occlusion()
    if not any(bool(t.any()) for t in touching.values()):
        scene.object_poses.log_scale.copy_(start)
        return 1.0, factors, costs
    best = factors[costs.argmin()]
    scene.object_poses.log_scale.copy_(start + best.log())
    return float(best), factors, costs

"""The object's size by steps on trial: at the right one hands soon lie in their outlines and on the surface.

Contact of hands as they stand says little where fingers are wrong or hidden, since those were fitted beside
an object of the wrong size. A few steps of everything that a stage minimises say more: how low the loss is
after them is a smooth function of the size.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch

from bigs.models.scene import Scene
from bigs.train.grasps.scale_search import lowest
from bigs.train.plan.config import OptimizeStage

_SIZE = "object.scale"


def try_sizes(scene: Scene, stage: OptimizeStage, run: Callable[[OptimizeStage], list[float]]) -> float:
    """Set the object's scale to where the stage's first steps get furthest; everything else stays as it is.

    Args:
        scene: with an object; its scale is changed in place.
        stage: with `size_trials`; its own rate of the size does not count.
        run: takes the steps of a stage and returns their losses.

    Returns:
        The factor by which the scale changed.
    """
    assert stage.size_trials is not None and scene.object_poses is not None
    log_scale = scene.object_poses.log_scale
    rates = {group: rate for group, rate in stage.lrs.items() if group != _SIZE}
    trial = replace(
        stage, steps=stage.size_trials.steps, lrs=rates, stop_patience=0, densify=None, size_trials=None
    )
    start = [(parameter, parameter.detach().clone()) for parameter in scene.parameters()]
    spacing = math.log1p(stage.size_trials.span)

    def resize(place: float) -> None:
        with torch.no_grad():
            for parameter, value in start:
                parameter.copy_(value)
            log_scale.add_(place * spacing)

    def cost(place: int) -> float:
        resize(place)
        losses = run(trial)
        late = losses[len(losses) // 2 :]
        return sum(late) / len(late)

    costs = {place: cost(place) for place in (-1, 0, 1)}
    while len(costs) < stage.size_trials.most:
        places = sorted(costs)
        best = min(places, key=costs.__getitem__)
        if best not in (places[0], places[-1]):
            break
        beyond = best + (1 if best > 0 else -1)
        costs[beyond] = cost(beyond)
    places = sorted(costs)
    found = lowest(torch.tensor(places), torch.tensor([costs[place] for place in places]))
    resize(found)
    return math.exp(found * spacing)

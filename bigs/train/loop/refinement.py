"""Where pictures show more of the object than its Gaussians can, and finer Gaussians there.

Once colours and poses have settled, what is left of the error comes from light, noise, poses, and from what
is smaller than a Gaussian. Only the last is a reason to split it: within the pixels that a Gaussian answers
for in one frame the error varies, so that no colour of its own could take it away.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bigs.models.object_detail import ObjectDetail, split_object
from bigs.models.scene import Scene
from bigs.train.loop.step import Evidence, Selection, Step, spread_frames
from bigs.train.plan.config import RefineStage

# Number of frames that are compared, and of those rendered together: fewer calls, but little memory.
_FRAMES = 16
_TOGETHER = 10
# A Gaussian that answers for fewer pixels than this in every frame is fine enough for any picture.
_LEAST_PIXELS = 2.0
_TINY = 1e-6


class Unresolved(NamedTuple):
    """What N Gaussians of the object leave unexplained."""

    # [N] squared error of colours within each one's pixels, after the one change of colour that suits these
    error: Tensor
    # [N] the most pixels that each answers for in a frame
    pixels: Tensor


@torch.no_grad()
def unresolved(scene: Scene, evidence: Evidence) -> Unresolved:
    """The error that finer Gaussians of the object could explain, summed over pixels of evenly spread frames.

    A picture is linear in colours, so its gradient by a Gaussian's colour is the share that this has in each
    pixel. Sums of the error over these shares, of its square and of one give the variance within them.
    """
    canonical = scene.canonical(scene.entities)
    count = len(canonical["object"].scales)
    error, pixels = torch.zeros(count), torch.zeros(count)
    for batch in spread_frames(scene.n_frames, _FRAMES).split(_TOGETHER):
        step = Step(scene, evidence, canonical, Selection(batch, scene.entities, labels=False))
        shows = step.share("object")[..., None]
        off = step.together.colors - step.images
        moments = torch.cat([shows * off.square().sum(-1, keepdim=True), shows * off, shows], dim=-1)
        sums = over_pixels(step, moments, count)
        answered = sums[..., 4]
        of_mean = sums[..., 1:4].square().sum(-1) / answered.clamp_min(_TINY)
        error += (sums[..., 0] - of_mean).clamp_min(0.0).sum(0)
        pixels = torch.maximum(pixels, answered.amax(0))
    return Unresolved(error, pixels)


def over_pixels(step: Step, values: Tensor, count: int) -> Tensor:
    """Sums [B, count, D] of values [B, H, W, D] over pixels, by the share of each of the object's Gaussians.

    Their number is `count`.
    """
    posed = step.posed_clip.at(step.frames).posed(step.canonical)
    channels = values.shape[-1]
    with torch.enable_grad():
        # Each frame has its own, so that the sums stay apart. The object is the last of a scene's entities.
        ink = torch.ones(len(values), count, channels, requires_grad=True)
        others = torch.zeros(len(values), posed.means.shape[1] - count, channels)
        picture = step.render(posed._replace(colors=torch.cat([others, ink], dim=1))).colors
        # Not `grad(picture, ink, values)`: torch then imports a computer algebra system, which takes a while.
        (sums,) = torch.autograd.grad((picture * values).sum(), ink)
    return sums


def fewest_holding(error: Tensor, share: float) -> Tensor:
    """The fewest of N [N] (bool) whose errors [N] sum up to a share of all; of equals the earlier."""
    order = error.argsort(descending=True, stable=True)
    before = error[order].cumsum(0) - error[order]
    chosen = torch.zeros(len(error), dtype=torch.bool)
    chosen[order[(before < share * error.sum())]] = True
    return chosen


def refined(
    scene: Scene, splats: ObjectDetail, stage: RefineStage, evidence: Evidence, freedom: Tensor
) -> ObjectDetail:
    """The object's Gaussians, those split that hide detail, without those that are transparent.

    Args:
        scene: the scene.
        splats: its object.
        stage: see there.
        evidence: pictures of the stage's size.
        freedom: [N] in [0, 1], the factor on what each one's parts learn from now on.
    """
    found = unresolved(scene, evidence)
    coarse = fewest_holding(found.error, stage.error_share) & (found.pixels >= _LEAST_PIXELS)
    with torch.no_grad():
        whole = splats()
    # An object that pictures make transparent altogether keeps its most opaque Gaussian.
    least = min(stage.least_opacity, float(whole.opacities.max()))
    return split_object(whole, torch.where(coarse, stage.parts, 1), least, freedom)

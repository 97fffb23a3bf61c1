"""The depth of each grasp and the object's size, from where fingers touch the object.

A picture says little of how far a hand is from the camera, least where an object or a sleeve hides it: short
grasps may end centimetres before or behind what they hold, where a finger's pull to the surface no longer
reaches. So every grasp is moved along its line of sight, and the gaps that its fingers leave are one opinion
of how far it is from the camera beside how far the object is. What grasps have in common is the object's
size, which a picture cannot see; the rest is what each hand is off by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from bigs.losses.contact import surface_gaps
from bigs.models.posed_scene import PosedScene
from bigs.models.poses import ObjectFrames
from bigs.models.scene import Scene
from bigs.train.grasps.scale_search import agreed, choices, in_words, lowest
from bigs.train.plan.config import GraspDepthStage
from bigs.types import Side


class FoundDepths(NamedTuple):
    """The result of a search."""

    size: float  # factor by which the object's scale changed
    spread: float  # standard error of the factor, as in `FoundSize`
    moved: dict[Side, Tensor]  # for each hand [G] factors by which the distance of its grasps changed

    def text(self) -> str:
        """The size in words, and its error where it is known."""
        return in_words(self.size, self.spread)

    def text_of(self, side: Side) -> str:
        """How far a hand's grasps moved, in words."""
        return ", ".join(f"x {factor:.3f}" for factor in self.moved[side].tolist()) or "(none)"


class _Grasp(NamedTuple):
    """A grasp that is searched."""

    side: Side
    number: int
    own: Tensor  # [T] bool, its frames
    error: float  # standard error of its hand's distance, relative


@torch.no_grad()
def search_grasp_depths(scene: Scene, stage: GraspDepthStage, seen: dict[Side, Tensor]) -> FoundDepths:
    """Set the object's scale, which does not change its projection, and the distances of grasps beside it.

    The likeliest size and distances: fingers leave few gaps, hands are about where they were, and the object
    is about as large as it was.

    Args:
        scene: with an object and hands; changed in place, left as it was without a grasp.
        stage: what to try, and the errors.
        seen: for each hand [T] how much of it its mask shows, in [0, 1].
    """
    assert scene.object_poses is not None
    logs = torch.linspace(-stage.span, stage.span, stage.candidates)
    posed = scene.at(torch.arange(scene.n_frames))
    grasps = [
        _Grasp(side, number, own, _error(_sights(posed, side, own), seen[side][own], stage))
        for side in scene.sides
        for number in range(scene.grasps[side].count)
        for own in [scene.grasps[side].of_frame == number]
    ]
    moved = {side: torch.ones(scene.grasps[side].count) for side in scene.sides}
    if not grasps:
        return FoundDepths(1.0, float("nan"), moved)
    size, spread = _size(scene, posed, grasps, logs, stage)
    carrier = _resized(posed.object, math.exp(size))

    def beside(side: Side, factor: Tensor) -> ObjectFrames:
        """The object as a hand meets it that is so many times as far away."""
        return carrier._replace(centers=carrier.centers - (factor - 1.0) * posed.hand(side).wrist)

    for grasp, costs in zip(grasps, _costs(scene, posed, grasps, logs, stage, beside), strict=True):
        away = lowest(logs, costs + 0.5 * (logs / grasp.error).square())
        moved[grasp.side][grasp.number] = math.exp(away)
        _move(scene, posed, grasp, math.exp(away - size))
    scene.object_poses.log_scale.add_(size)
    return FoundDepths(math.exp(size), spread, moved)


def _size(
    scene: Scene, posed: PosedScene, grasps: Sequence[_Grasp], logs: Tensor, stage: GraspDepthStage
) -> tuple[float, float]:
    """The object's likeliest logarithmic size, each grasp at the distance that suits it best, and its error.

    A hand that moves towards an object meets it nearly as if the object had come nearer, and smaller.
    """

    def nearer(side: Side, factor: Tensor) -> ObjectFrames:
        return _resized(posed.object, factor)

    each = []
    for grasp, costs in zip(grasps, _costs(scene, posed, grasps, logs, stage, nearer), strict=True):
        wrists, centers = (
            points[grasp.own].norm(dim=-1).mean()
            for points in (posed.hand(grasp.side).wrist, posed.object.centers)
        )
        hands = centers / wrists * (logs - logs[:, None])
        each.append((costs + 0.5 * (hands / grasp.error).square()).amin(1))
    prior = 0.5 * (logs / stage.size_error).square()
    if len(each) == 1:
        return lowest(logs, each[0] + prior), float("nan")
    asked = choices(len(each)).to(logs) @ torch.stack(each)
    return agreed(torch.tensor([lowest(logs, costs + prior) for costs in asked]))


def _costs(
    scene: Scene,
    posed: PosedScene,
    grasps: Sequence[_Grasp],
    logs: Tensor,
    stage: GraspDepthStage,
    place: Callable[[Side, Tensor], ObjectFrames],
) -> list[Tensor]:
    """For each grasp how unlikely its gaps are [C] with the object where `place` puts it at each factor."""
    gaps: dict[Side, Tensor] = {}
    for side in scene.sides:
        depths = torch.stack([posed.touch(side, place(side, factor)).depths for factor in logs.exp()])
        gap = surface_gaps(depths, stage.reach)
        gaps[side] = (gap[:, :, 0] + gap[:, :, 1:].mean(2)) * scene.grasps[side].certainty
    return [stage.weight * gaps[grasp.side][:, grasp.own].mean(1) for grasp in grasps]


def _resized(carrier: ObjectFrames, factor: Tensor | float) -> ObjectFrames:
    """The object so many times as large and as far away."""
    return ObjectFrames(carrier.rotations, factor * carrier.centers, factor * carrier.scale)


def _sights(posed: PosedScene, side: Side, own: Tensor) -> Tensor:
    """From the camera to the wrist in some frames [T] (bool), along the object's axes, metres: [B, 3]."""
    rotations = posed.object.rotations[own]
    return (rotations.transpose(-1, -2) @ posed.hand(side).wrist[own][..., None])[..., 0]


def _error(sights: Tensor, seen: Tensor, stage: GraspDepthStage) -> float:
    """How far the outlines of a grasp may be wrong about its distance, relative.

    The less of a hand is seen [B] the less its outline tells. Where the object turns, later frames see from
    aside what is depth in earlier ones. Frames of a grasp err alike, so that many say no more than a few.
    """
    rays = torch.nn.functional.normalize(sights, dim=-1).double()
    along = rays[:, :, None] * rays[:, None, :]
    aside = torch.eye(3, dtype=torch.float64) - along
    depth = (stage.error_along / seen.double()).clamp(max=stage.error_hidden)[:, None, None]
    information = (aside / stage.error_aside**2 + along / depth**2).mean(0)
    middle = torch.nn.functional.normalize(rays.mean(0), dim=0)
    return math.sqrt(float(middle @ torch.linalg.solve(information, middle)))


def _move(scene: Scene, posed: PosedScene, grasp: _Grasp, factor: float) -> None:
    """Move a grasp along its line of sight, by a factor on its distance from the camera."""
    shift = (factor - 1.0) * _sights(posed, grasp.side, grasp.own).mean(0) / posed.object.scale
    scene.grasps[grasp.side].position[grasp.number] += shift

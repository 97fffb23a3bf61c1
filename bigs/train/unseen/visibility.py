"""Which Gaussians a clip shows in the current poses, and how well."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from bigs.geometry.coverage import ObjectViews, times_seen
from bigs.losses.photometric import masked_l1
from bigs.models.canonical import CanonicalObject
from bigs.models.scene import Scene
from bigs.train.loop.refinement import over_pixels
from bigs.train.loop.step import Evidence, Selection, Step, spread_frames
from bigs.types import Entity, Gaussians

# Typical error of poses, metres.
TOLERANCE = 0.006
# A Gaussian with at least this weight in some frame's picture, in pixels, shows.
SHOWS = 0.002
# Number of frames that are rendered together: fewer calls, but little memory.
_TOGETHER = 10
# Number of frames on which errors are measured.
_GUARD_FRAMES = 12
# Number of frames that say what the clip shows.
_SHOWN_FRAMES = 30
# Of an even surface that faces the camera each Gaussian weighs 0.4 of its own picture, since neighbours
# overlap. Seen at 70 degrees it weighs a third of that.
_IN_VIEW = 0.15


def object_views(scene: Scene, evidence: Evidence) -> ObjectViews:
    """Where the object shows in each frame, in its own units: the camera's distance changes with its size."""
    pose = scene.at(torch.arange(scene.n_frames)).object
    shown = evidence.targets.shares["object"] > 0.5
    centers = pose.centers / pose.scale
    return ObjectViews(
        shown.numpy(), evidence.targets.K.numpy(), pose.rotations.numpy(), centers.numpy().astype(np.float64)
    )


def frames_seen(canonical: CanonicalObject, views: ObjectViews) -> np.ndarray:
    """In how many frames [N] each of the object's Gaussians shows."""
    points = canonical.means.numpy().astype(np.float64)
    return times_seen(views, points, canonical.normals.numpy(), points, TOLERANCE)


def guard_frames(n_frames: int) -> Tensor:
    """The frames of a clip on which errors are measured."""
    return spread_frames(n_frames, _GUARD_FRAMES)


@torch.no_grad()
def weights_in_pictures(scene: Scene, evidence: Evidence) -> Tensor:
    """The most [N] that each of the object's Gaussians weighs in the picture of any frame, in pixels.

    What hands and nearer surface hide weighs nothing.
    """
    canonical = scene.canonical(scene.entities)
    count = len(canonical["object"].scales)
    most = torch.zeros(count)
    for frames in torch.arange(scene.n_frames).split(_TOGETHER):
        step = Step(scene, evidence, canonical, Selection(frames, scene.entities, labels=False))
        weights = over_pixels(step, torch.ones_like(step.share("object"))[..., None], count)
        most = torch.maximum(most, weights[..., 0].amax(0))
    return most


def shown(scene: Scene, evidence: Evidence) -> dict[Entity, Tensor]:
    """How well the clip shows each Gaussian, [N] in [0, 1] by entity; of hands, those that are trained.

    It is a product. The first factor is what a Gaussian weighs in pixels that show its subject, by what it
    weighs in all pixels, squared: the most in a frame of either. It is near 0 below a sleeve, which no
    Gaussian draws, and where object or hand always hide it. The second is what it weighs in the frame that
    shows it best, by the picture of it alone and from the front: near 0 where no frame looks at its side but
    at a grazing angle. Both hands count where they share one canonical hand.
    """
    with torch.no_grad():
        canonical = scene.canonical(scene.entities)
    own: dict[Entity, Tensor] = {}
    whole: dict[Entity, Tensor] = {}
    part: dict[Entity, Tensor] = {}
    for frames in spread_frames(scene.n_frames, _SHOWN_FRAMES).split(_TOGETHER):
        step = Step(scene, evidence, canonical, Selection(frames, scene.entities, labels=False))
        with torch.no_grad():
            posed = scene.at(frames).posed(canonical)
        ink = torch.ones(*posed.means.shape[:2], 1, requires_grad=True)
        picture = step.render(posed._replace(colors=ink)).colors[..., 0]
        (anywhere,) = torch.autograd.grad(picture.sum(), ink, retain_graph=True)
        of_front = anywhere[..., 0] / _from_the_front(posed, evidence)
        first = 0
        for entity in scene.entities:
            (inside,) = torch.autograd.grad((picture * step.share(entity)).sum(), ink, retain_graph=True)
            trained = "object" if entity == "object" else scene.canonical_side(entity)
            rows = slice(first, first + len(canonical[entity].scales))
            first = rows.stop
            for most, weights in ((own, inside[..., 0]), (whole, anywhere[..., 0]), (part, of_front)):
                found = weights[:, rows].amax(0)
                most[trained] = torch.maximum(most.get(trained, found), found)
    return {
        entity: (own[entity] / (whole[entity] + SHOWS)).square() * (part[entity] / _IN_VIEW).clamp(max=1.0)
        for entity in own
    }


def _from_the_front(posed: Gaussians, evidence: Evidence) -> Tensor:
    """The area [B, N] in pixels of each Gaussian's picture if its thinnest axis pointed at the camera."""
    pixels = evidence.targets.K[0, 0] / posed.means[..., 2].clamp_min(1e-3)
    wide = posed.scales.sort(dim=-1).values[..., 1:]
    variances = (pixels[..., None] * wide).square() + evidence.settings.eps2d
    return 2.0 * math.pi * variances.prod(-1).sqrt()


@torch.no_grad()
def overflow(scene: Scene, evidence: Evidence, frames: Tensor) -> Tensor:
    """How large the object's picture is in each of some frames [B]: 1 as its mask allows, more beyond it.

    Where hands or something unlabelled may hide it, the mask allows everything.
    """
    step = Step(scene, evidence, scene.canonical(("object",)), Selection(frames, ("object",), labels=False))
    hidden = step.hidden_alone("object")
    beyond = (1.0 - hidden - step.share("object")).clamp_min(0.0)
    outside = (beyond * step.alone("object").alphas[..., 0]).sum((1, 2))
    return 1.0 + outside / step.share("object").sum((1, 2)).clamp_min(1.0)


@torch.no_grad()
def image_error(scene: Scene, evidence: Evidence, entities: Sequence[Entity], frames: Tensor) -> float:
    """Mean absolute error of the colours where some entities, rendered together, show in the clip."""
    step = Step(scene, evidence, scene.canonical(entities), Selection(frames, tuple(entities), labels=False))
    shares = torch.stack([step.share(entity) for entity in entities]).sum(0).clamp(max=1.0)
    return float(masked_l1(step.together.colors, step.images, shares))

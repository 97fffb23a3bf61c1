"""A diffusion prior on the object of a scene: what the clip saw of it, and what the prior may change."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from bigs.geometry.coverage import ObjectViews, times_seen
from bigs.guidance.cameras import Orbit, make_orbit
from bigs.guidance.denoiser import Denoiser
from bigs.losses.photometric import masked_l1
from bigs.models.object_detail import ObjectDetail, split_object
from bigs.models.scene import Scene
from bigs.train.config import GuidanceStage
from bigs.train.guided import Coverage, coverage_of, follow, guide_object
from bigs.train.step import Evidence
from bigs.train.step import Step as LossStep

# A Gaussian counts as seen when it shows in so many frames; poses are wrong by about so much, metres.
_LEAST_FRAMES, _TOLERANCE = 3, 0.006
# Frames on which the guard looks.
_GUARD_FRAMES = 12


class GuidedScene(NamedTuple):
    """What there is to tell."""

    skipped: str | None  # why nothing was changed
    facts: dict[str, str]


@torch.no_grad()
def scene_coverage(scene: Scene, evidence: Evidence) -> tuple[Coverage, Orbit]:
    """How much of the object's Gaussians the clip has seen, and the sphere from which the rest is looked at.

    The front is where the clip's camera stood on average, and up is what was up in its pictures.
    """
    canonical = scene.object_splats()
    pose = scene.object_frames(torch.arange(scene.n_frames))
    # In the object's own units the camera's distance, not the object, changes with its size.
    rotations, centers = pose.rotations, pose.centers / pose.scale
    shown = evidence.targets.shares["object"] > 0.5
    views = ObjectViews(shown.numpy(), evidence.targets.K.numpy(), rotations.numpy(), centers.numpy())
    points, normals = canonical.means.numpy().astype(np.float64), canonical.normals.numpy()
    frames = times_seen(views, points, normals, points, _TOLERANCE)
    seen = torch.as_tensor(frames >= min(_LEAST_FRAMES, scene.n_frames))
    up = -rotations[:, 1].mean(0)
    towards = -(rotations.transpose(-1, -2) @ centers[..., None])[..., 0]
    front = torch.nn.functional.normalize(towards, dim=-1).mean(0)
    return coverage_of(canonical.normals, seen), make_orbit(canonical.means, up, front)


def guide_scene(
    scene: Scene,
    evidence: Evidence,
    denoiser: Denoiser,
    stage: GuidanceStage,
    seed: int,
    after_step: Callable[[int, float], None] = lambda step, loss: None,
) -> GuidedScene:
    """Let a prior complete the scene's object, in place; its surface follows its Gaussians.

    Args:
        scene: has an object.
        evidence: the clip at the size at which the guard looks.
        denoiser: the prior.
        stage: see that class.
        seed: of views, timesteps and noise.
        after_step: told the steps done and the loss.
    """
    scene.requires_grad_(False)
    if not isinstance(scene.object_splats, ObjectDetail):
        scene.object_splats = split_object(scene.object_splats(), 1, 0.0)
    detail = scene.object_splats
    coverage, orbit = scene_coverage(scene, evidence)
    facts = {"object seen before the prior": f"{coverage.share:.0%} of its Gaussians"}
    if coverage.share >= stage.enough or not (coverage.by_direction < stage.well_seen).any():
        return GuidedScene(f"{coverage.share:.0%} of the object was seen", facts)
    frames = torch.linspace(0, scene.n_frames - 1, min(_GUARD_FRAMES, scene.n_frames)).round().long()

    @torch.no_grad()
    def image_error() -> float:
        step = LossStep(scene, evidence, ("object",), scene.canonical(("object",)), frames)
        return float(masked_l1(step.alone("object").colors, step.images, step.share("object")))

    with torch.no_grad():
        means = detail().means.clone()
    done = guide_object(
        detail, coverage, orbit, denoiser, stage, evidence.settings, image_error, seed, after_step
    )
    change = f"{done.after / max(done.before, 1e-12) - 1.0:+.1%}"
    if done.rolled_back:
        return GuidedScene(f"undone, since what was seen would show worse ({change} error)", facts)
    with torch.no_grad():
        scene.surface_verts.copy_(follow(scene.surface_verts, means, done.moved))
    moved = 1e3 * float(done.moved[~coverage.seen].norm(dim=-1).mean())
    looked = float((coverage.by_direction < stage.well_seen).float().mean())
    facts["prior"] = (
        f"looked from {looked:.0%} of all directions, moved what was not seen by {moved:.1f} mm on average; "
        f"error of what was seen {change}"
    )
    return GuidedScene(None, facts)

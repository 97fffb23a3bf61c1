"""A diffusion prior on the object of a scene: what the clip saw of it, and what the prior may change."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from bigs.guidance.cameras import Orbit, make_orbit
from bigs.guidance.denoiser import Denoiser
from bigs.models.object_detail import ObjectDetail, split_object
from bigs.models.scene import Scene
from bigs.train.completed_scene import CompletedScene
from bigs.train.config import GuidanceStage
from bigs.train.guided import AfterStep, Coverage, coverage_of, follow, guide_object
from bigs.train.seen import frames_seen, guard_frames, image_error, object_views
from bigs.train.step import Evidence

# A Gaussian counts as seen when it shows in so many frames: fewer may be a fault of mask or pose.
_LEAST_FRAMES = 3


@torch.no_grad()
def scene_coverage(scene: Scene, evidence: Evidence) -> tuple[Coverage, Orbit]:
    """How much of the object's Gaussians the clip has seen, and the sphere from which the rest is looked at.

    The front is where the clip's camera stood on average, and up is what was up in its pictures.
    """
    canonical = scene.object_splats()
    frames = frames_seen(canonical, object_views(scene, evidence))
    seen = torch.as_tensor(frames >= min(_LEAST_FRAMES, scene.n_frames))
    pose = scene.at(torch.arange(scene.n_frames)).object
    up = -pose.rotations[:, 1].mean(0)
    towards = -(pose.rotations.transpose(-1, -2) @ pose.centers[..., None])[..., 0]
    front = torch.nn.functional.normalize(towards, dim=-1).mean(0)
    return coverage_of(canonical.normals, seen), make_orbit(canonical.means, up, front)


def guide_scene(
    scene: Scene,
    evidence: Evidence,
    denoiser: Denoiser,
    stage: GuidanceStage,
    seed: int,
    resume: Mapping[str, Any] | None = None,
    after_step: AfterStep = lambda state, loss: None,
) -> CompletedScene:
    """Let a prior complete the scene's object, in place; its surface follows its Gaussians.

    Args:
        scene: has an object.
        evidence: the clip at the size at which the guard looks.
        denoiser: the prior.
        stage: see that class.
        seed: of views, timesteps and noise.
        resume: of an interrupted stage, as `checkpoint.load_checkpoint` returns it.
        after_step: told the state after every step, and the loss.
    """
    scene.requires_grad_(False)
    if not isinstance(scene.object_splats, ObjectDetail):
        scene.object_splats = split_object(scene.object_splats(), 1, 0.0)
    detail = scene.object_splats
    if resume is not None:
        # What was seen, and how well it showed, is told by the object as the stage found it.
        resume = {**resume, "reached": {name: getattr(detail, name).clone() for name in resume["found"]}}
        detail.load_state_dict({**detail.state_dict(), **resume["found"]})
    coverage, orbit = scene_coverage(scene, evidence)
    facts = {"object seen before the prior": f"{coverage.share:.0%} of its Gaussians"}
    if coverage.share >= stage.enough or not (coverage.by_direction < stage.well_seen).any():
        return CompletedScene(f"{coverage.share:.0%} of the object was seen", facts)
    frames = guard_frames(scene.n_frames)

    def error() -> float:
        return image_error(scene, evidence, ("object",), frames)

    with torch.no_grad():
        means = detail().means.clone()
    done = guide_object(
        detail, coverage, orbit, denoiser, stage, evidence.settings, error, seed, resume, after_step
    )
    change = f"{done.after / max(done.before, 1e-12) - 1.0:+.1%}"
    if done.rolled_back:
        return CompletedScene(f"undone, since what was seen would show worse ({change} error)", facts)
    with torch.no_grad():
        scene.surface_verts.copy_(follow(scene.surface_verts, means, done.moved))
    moved = 1e3 * float(done.moved[~coverage.seen].norm(dim=-1).mean())
    looked = float((coverage.by_direction < stage.well_seen).float().mean())
    facts["prior"] = (
        f"looked from {looked:.0%} of all directions, moved what was not seen by {moved:.1f} mm on average; "
        f"error of what was seen {change}"
    )
    return CompletedScene(None, facts)

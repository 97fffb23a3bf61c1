"""A diffusion prior on a scene's object: what the clip saw of it, and what the prior may change."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from bigs.guidance.cameras import Orbit, virtual_cameras
from bigs.guidance.denoiser import Conditions, Denoiser
from bigs.guidance.residual import picture_residual
from bigs.models.canonical import CanonicalObject
from bigs.models.object_detail import ObjectDetail, split_object
from bigs.models.scene import Scene
from bigs.raster.settings import RasterSettings
from bigs.train.loop.step import Evidence, Selection, Step, spread_frames
from bigs.train.loop.virtual_views import object_orbit, render_object
from bigs.train.plan.config import GuidanceStage
from bigs.train.unseen.prior_descent import (
    AfterStep,
    Coverage,
    FrameLoss,
    coverage_of,
    follow,
    guide_object,
)
from bigs.train.unseen.symmetry_stage import StageOutcome
from bigs.train.unseen.visibility import (
    SHOWS,
    frames_seen,
    guard_frames,
    image_error,
    object_views,
    overflow,
    weights_in_pictures,
)

# A Gaussian counts as seen if it shows in this many frames: fewer may be an error of a mask or pose.
_LEAST_FRAMES = 3
# Putting one back may reveal the next, so they are checked again.
_PASSES = 3
# Number of frames that keep the object as it was.
_KEEPING_FRAMES = 60


@torch.no_grad()
def scene_coverage(scene: Scene, evidence: Evidence) -> tuple[Coverage, Orbit]:
    """How much of the object the clip has seen, and the sphere from which the rest is looked at."""
    canonical = scene.object_splats()
    frames = frames_seen(canonical, object_views(scene, evidence))
    seen = torch.as_tensor(frames >= min(_LEAST_FRAMES, scene.n_frames))
    pose = scene.at(torch.arange(scene.n_frames)).object
    return coverage_of(canonical.normals, seen), object_orbit(canonical.means, pose)


def guide_scene(
    scene: Scene,
    evidence: Evidence,
    denoiser: Denoiser,
    stage: GuidanceStage,
    seed: int,
    resume: Mapping[str, Any] | None = None,
    after_step: AfterStep = lambda state, loss: None,
) -> StageOutcome:
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
        # What was seen, and how well, is measured on the object as the stage found it.
        resume = {**resume, "reached": {name: getattr(detail, name).clone() for name in resume["found"]}}
        detail.load_state_dict({**detail.state_dict(), **resume["found"]})
    coverage, orbit = scene_coverage(scene, evidence)
    facts = {"object seen before the prior": f"{coverage.share:.0%} of its Gaussians"}
    if coverage.share >= stage.enough or not (coverage.by_direction < stage.well_seen).any():
        return StageOutcome(f"{coverage.share:.0%} of the object was seen", facts)
    with torch.no_grad():
        canonical = detail()
    strange = strangeness(canonical, coverage, orbit, denoiser, stage, evidence.settings)
    if strange > stage.unlike:
        reason = (
            f"left out, since the prior does not know this object: on its seen sides it is {strange:.1f} "
            f"times as wrong as on its own meshes ({stage.unlike} is allowed)"
        )
        return StageOutcome(reason, facts)
    # What shows in any frame stays, even if too few frames show it to be sure.
    fixed = coverage._replace(seen=coverage.seen | (weights_in_pictures(scene, evidence) >= SHOWS))
    if fixed.seen.all():
        return StageOutcome("all of the object's Gaussians show", facts)
    found = {name: value.clone() for name, value in detail.state_dict().items()}
    some, every = guard_frames(scene.n_frames), torch.arange(scene.n_frames)

    def faults() -> Tensor:
        error = image_error(scene, evidence, ("object",), some)
        return torch.cat([torch.tensor([error]), overflow(scene, evidence, every)])

    done = guide_object(
        detail,
        fixed,
        orbit,
        denoiser,
        stage,
        evidence.settings,
        faults,
        frame_loss(scene, evidence, canonical, stage.frame_weight),
        seed,
        resume,
        after_step,
    )
    if done.rolled_back:
        reason = f"undone, since the clip's frames would look worse ({done.worst:+.1%} error or size)"
        return StageOutcome(reason, facts)
    _put_back(scene, evidence, detail, found, fixed.seen)
    with torch.no_grad():
        scene.surface_verts.copy_(follow(scene.surface_verts, canonical.means, done.moved))
    moved = 1e3 * float(done.moved[~fixed.seen].norm(dim=-1).mean())
    looked = float((coverage.by_direction < stage.well_seen).float().mean())
    facts["prior"] = (
        f"looked from {looked:.0%} of all directions, moved what was not seen by {moved:.1f} mm on average; "
        f"error of the seen part {done.worst:+.1%} at most"
    )
    return StageOutcome(None, facts)


def _put_back(
    scene: Scene, evidence: Evidence, detail: ObjectDetail, found: Mapping[str, Tensor], fixed: Tensor
) -> None:
    """Give Gaussians that were not `fixed` [N] and have come to show in a frame what they had before."""
    free = ~fixed
    for _ in range(_PASSES):
        showing = free & (weights_in_pictures(scene, evidence) >= SHOWS)
        if not showing.any():
            return
        for name, value in detail.state_dict().items():
            value[showing] = found[name][showing]
        free &= ~showing


def strangeness(
    canonical: CanonicalObject,
    coverage: Coverage,
    orbit: Orbit,
    denoiser: Denoiser,
    stage: GuidanceStage,
    settings: RasterSettings,
) -> float:
    """How wrong a prior is about the sides that were seen, as a multiple of what it is on what it knows.

    The sides that were seen are right, so a prior that believes in something else there is no help with the
    others. 0 of a prior that does not say what it knows.
    """
    if denoiser.familiar is None:
        return 0.0
    best = coverage.by_direction.argsort(descending=True, stable=True)[: len(coverage.directions) // 10]
    cameras = virtual_cameras(orbit, coverage.directions[best], stage.image_size)
    with torch.no_grad():
        images = render_object(canonical, cameras, stage.image_size, settings)
    asked = Conditions(cameras.azimuths, cameras.elevations)
    return picture_residual(denoiser, images, asked) / denoiser.familiar


def frame_loss(scene: Scene, evidence: Evidence, canonical: CanonicalObject, weight: float) -> FrameLoss:
    """The distance between what a frame shows of the object and what it showed of `canonical`.

    Summed over the pixels in which nothing hides the object, if it is there; background counts.
    """
    frames = spread_frames(scene.n_frames, _KEEPING_FRAMES)

    def picture(now: CanonicalObject, frames: Tensor) -> Tensor:
        step = Step(scene, evidence, {"object": now}, Selection(frames, ("object",), labels=False))
        shown = step.alone("object")
        free = 1.0 - step.hidden_alone("object")
        return free[..., None] * torch.cat([shown.colors, shown.alphas], dim=-1)

    with torch.no_grad():
        found = torch.cat([picture(canonical, frame) for frame in frames[:, None]])

    def loss(now: CanonicalObject, generator: torch.Generator) -> Tensor:
        chosen = torch.randint(len(frames), (1,), generator=generator)
        return weight * (picture(now, frames[chosen]) - found[chosen]).abs().sum()

    return loss

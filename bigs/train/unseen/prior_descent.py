"""The object's unseen Gaussians follow a diffusion prior (paper Eq. 7); what was seen stays as it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.spatial
import torch
from torch import Tensor

from bigs.geometry.arrays import float32
from bigs.geometry.coverage import coverage_by_direction, sphere_directions
from bigs.guidance.cameras import (
    Orbit,
    draw_directions,
    view_weights,
    virtual_cameras,
)
from bigs.guidance.denoiser import Conditions, Denoiser
from bigs.guidance.schedule import SdsConfig
from bigs.guidance.sds import sds_loss
from bigs.models.canonical import CanonicalObject
from bigs.models.object_detail import ObjectDetail
from bigs.raster.settings import RasterSettings
from bigs.train.loop.adam import FrameAdam
from bigs.train.loop.run_stage import StageState
from bigs.train.loop.virtual_views import render_object
from bigs.train.plan.config import GuidanceStage

# Directions from which the object is viewed, before jitter.
_DIRECTIONS = 256
_NEIGHBOURS = 8


# Called with the state and the loss after every step.
AfterStep = Callable[[StageState, float], None]
# The loss by which the clip's frames keep the object as it was at the start; it draws from the given
# generator.
FrameLoss = Callable[[CanonicalObject, torch.Generator], Tensor]


class Coverage(NamedTuple):
    """How much of the object a clip has seen."""

    seen: Tensor  # [N] bool, per Gaussian
    directions: Tensor  # [D, 3] unit, object frame
    by_direction: Tensor  # [D] in [0, 1]

    @property
    def share(self) -> float:
        """The share of the Gaussians that was seen, in [0, 1]."""
        return float(self.seen.float().mean())


def coverage_of(normals: Tensor, seen: Tensor) -> Coverage:
    """The coverage of Gaussians with unit normals [N, 3], of which those marked in `seen` [N] were seen."""
    directions = sphere_directions(_DIRECTIONS)
    covered = coverage_by_direction(normals.numpy().astype(np.float64), seen.numpy(), directions)
    return Coverage(seen, float32(directions), float32(covered))


@dataclass(frozen=True)
class Guided:
    """The effect of the prior."""

    moved: Tensor  # [N, 3] metres that the Gaussians' centres moved
    worst: float  # relative growth of the largest error
    rolled_back: bool


def guide_object(
    detail: ObjectDetail,
    coverage: Coverage,
    orbit: Orbit,
    denoiser: Denoiser,
    stage: GuidanceStage,
    settings: RasterSettings,
    faults: Callable[[], Tensor],
    frame_loss: FrameLoss | None = None,
    seed: int = 0,
    resume: Mapping[str, Any] | None = None,
    after_step: AfterStep = lambda state, loss: None,
) -> Guided:
    """Optimise what was not seen of the object in place by score distillation from virtual cameras.

    No gradient reaches a Gaussian that was seen. Unseen ones can still come to stand before seen ones, shine
    through them, or leave the silhouette. `frame_loss` speaks against that, and its faults are measured
    before and after. All is undone if one of them grew more than the stage allows.

    Args:
        detail: the object's own Gaussians, as the stage found them.
        coverage: which of them were seen; some were not.
        orbit: where the virtual cameras stand.
        denoiser: the prior.
        stage: steps, rates, weights.
        settings: of the renderer.
        faults: [K] positive measures of how badly the object, as it is now, agrees with the clip.
        frame_loss: added to the prior's loss; see `FrameLoss`.
        seed: of views, timesteps and noise.
        resume: steps done, moments, and what the Gaussians' parameters had become ("reached"), by name.
        after_step: told the state after every step, and the loss.

    Raises:
        FloatingPointError: the prior's estimate is not finite.
    """
    sds = SdsConfig(stage.t_first, stage.t_last)
    weights = view_weights(coverage.by_direction, stage.well_seen)
    rates = {
        "shift": stage.lr_shift,
        "size": stage.lr_size,
        "opacity": stage.lr_opacity,
        "color": stage.lr_color,
    }
    parameters = {name: getattr(detail, name) for name in rates}
    found = {name: value.clone() for name, value in detail.state_dict().items()}
    unseen = ~coverage.seen
    # What hardly shows kept what it began with. Now it is the prior's.
    detail.release(unseen)
    with torch.no_grad():
        start = detail().means.clone()
    neighbours, spacing = _neighbours(start)
    before = faults()
    for parameter in parameters.values():
        parameter.requires_grad_(True)
    optimizer = FrameAdam(
        [{"params": [parameters[name]], "lr": lr} for name, lr in rates.items()], betas=(0.9, 0.99)
    )
    done = 0
    if resume is not None:
        done = resume["step"]
        optimizer.set_moments(resume["moments"])
        with torch.no_grad():
            for name, parameter in parameters.items():
                parameter.copy_(resume["reached"][name])
    for step in range(done, stage.steps):
        # A function of seed and step, so that a resumed run draws the same.
        generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
        directions = draw_directions(coverage.directions, weights, stage.views, generator)
        cameras = virtual_cameras(orbit, directions, stage.image_size)
        canonical = _freed(detail(), unseen)
        images = render_object(canonical, cameras, stage.image_size, settings)
        prior = sds_loss(
            denoiser,
            images,
            Conditions(cameras.azimuths, cameras.elevations),
            sds,
            progress=step / stage.steps,
            generator=generator,
        )
        # Neighbours move together, so that the surface stays connected.
        rough = (detail.shift - detail.shift[neighbours].mean(1)) / spacing
        loss = prior + stage.smooth * rough[unseen].square().sum()
        if frame_loss is not None:
            loss = loss + frame_loss(canonical, generator)
        optimizer.zero_grad()
        loss.backward()
        for parameter in parameters.values():
            parameter.grad[coverage.seen] = 0.0
        optimizer.step()
        after_step(StageState.begun(step + 1, optimizer, found), float(loss.detach()))
    for parameter in parameters.values():
        parameter.requires_grad_(False)
    worst = float((faults() / before.clamp_min(1e-12)).max()) - 1.0
    if worst > stage.damage:
        detail.load_state_dict(found)
        return Guided(torch.zeros_like(start), worst, True)
    with torch.no_grad():
        return Guided(detail().means - start, worst, False)


def _freed(canonical: CanonicalObject, free: Tensor) -> CanonicalObject:
    """The same Gaussians; gradients reach only those marked in `free` [N]."""
    fixed = (
        torch.where(free.reshape(-1, *[1] * (value.ndim - 1)), value, value.detach()) for value in canonical
    )
    return CanonicalObject(*fixed)


def _neighbours(means: Tensor) -> tuple[Tensor, float]:
    """The nearest others [N, K] of points [N, 3], and the median distance to the first, metres."""
    distance, index = scipy.spatial.cKDTree(means.numpy()).query(means.numpy(), k=_NEIGHBOURS + 1)
    return torch.as_tensor(index[:, 1:]), float(np.median(distance[:, 1]))


def follow(verts: Tensor, means: Tensor, moved: Tensor) -> Tensor:
    """A mesh's vertices [V, 3], moved as the Gaussians around them, at `means` [N, 3], by `moved` [N, 3]."""
    distance, index = scipy.spatial.cKDTree(means.numpy()).query(verts.numpy(), k=_NEIGHBOURS)
    weights = torch.as_tensor(1.0 / (distance + 1e-4), dtype=verts.dtype)
    weights = weights / weights.sum(1, keepdim=True)
    return verts + (weights[..., None] * moved[torch.as_tensor(index)]).sum(1)

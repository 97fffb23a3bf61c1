"""The object alone, from cameras around it that the clip never had."""

from __future__ import annotations

import torch
from torch import Tensor

from bigs.guidance.cameras import Orbit, VirtualCameras, make_orbit
from bigs.models.canonical import CanonicalObject
from bigs.models.poses import ObjectFrames
from bigs.raster import rasterization
from bigs.raster.settings import RasterSettings


@torch.no_grad()
def object_orbit(means: Tensor, poses: ObjectFrames) -> Orbit:
    """The sphere around the object's centres [N, 3], which has `poses` in the clip.

    The front is where the clip's camera stood on average, and up is what was up in its pictures.
    """
    up = -poses.rotations[:, 1].mean(0)
    towards = -(poses.rotations.transpose(-1, -2) @ poses.centers[..., None])[..., 0]
    return make_orbit(means, up, torch.nn.functional.normalize(towards, dim=-1).mean(0))


def render_object(
    canonical: CanonicalObject, cameras: VirtualCameras, size: int, settings: RasterSettings
) -> Tensor:
    """Pictures [B, 3, size, size] of the object alone, unlit, on white."""
    out = rasterization(
        canonical.means,
        canonical.quats,
        canonical.scales,
        canonical.opacities,
        canonical.colors,
        cameras.viewmats,
        cameras.K.expand(len(cameras.viewmats), 3, 3),
        size,
        size,
        settings=settings,
        backgrounds=torch.ones(len(cameras.viewmats), 3),
    )
    return out.colors.permute(0, 3, 1, 2)

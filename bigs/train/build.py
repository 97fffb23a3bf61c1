"""A scene at its start values: canonical hands, the object's surface and its Gaussians, smoothed poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.spatial
import torch
from torch import Tensor

from bigs.data.base import Clip
from bigs.geometry.distance import DistanceField
from bigs.geometry.mesh import sample_surface
from bigs.geometry.surface import extract_mesh
from bigs.hand import HandModel, shared_betas
from bigs.models.hand_splats import HandSplats, HandSplatsConfig
from bigs.models.lighting import Lighting
from bigs.models.object_splats import ObjectSplats, ObjectSplatsConfig
from bigs.models.poses import HandPoses, ObjectPoses
from bigs.models.scene import ObjectSurface, Scene
from bigs.train.carving import carve, convex_surface
from bigs.train.initial import (
    InitialConfig,
    ObjectStart,
    hand_in_camera,
    object_in_camera,
    smooth_hand,
    smooth_object,
)
from bigs.types import Side


class SceneStart(NamedTuple):
    """A scene at its start values, and what there is to say about them."""

    scene: Scene
    skipped: list[str]  # what was not done, or replaced by something simpler, and why


def build_scene(
    clip: Clip,
    unknown: np.ndarray,
    hand_models: Mapping[Side, HandModel],
    initial: InitialConfig,
    hand: HandSplatsConfig,
    obj: ObjectSplatsConfig,
    lighting: bool,
) -> SceneStart:
    """A scene at its start values.

    Args:
        clip: the loaded clip.
        unknown: [T, H, W] bool, unlabelled occluders (see `background`).
        hand_models: both sides' models in their files' own conventions.
        initial, hand, obj: see those classes.
        lighting: whether colours depend on the direction a surface faces.
    """
    starts = {
        side: smooth_hand(
            hand_in_camera(track, clip.cam_from_world, hand_models[side], initial), initial.smooth_hands
        )
        for side, track in clip.hands.items()
    }
    canonical = _canonical_hands(clip, hand_models, hand)
    skipped: list[str] = []
    object_parts = dict.fromkeys(("object_splats", "object_poses", "object_surface", "object_distance"), None)
    if clip.object is not None:
        start = smooth_object(object_in_camera(clip, initial), initial.smooth_object)
        try:
            carving = carve(clip, unknown, start, initial)
            grid = carving.closed(initial, carving.points, carving.normals, initial.surface_reach)
            verts, faces = extract_mesh(grid)
        except (ValueError, scipy.spatial.QhullError) as reason:
            skipped.append(f"object surface from masks: {reason}; the points' convex hull stands in for it")
            grid = convex_surface(start, initial)
            verts, faces = extract_mesh(grid)
        points, normals = sample_surface(verts, faces, obj.n_gaussians)
        object_parts = {
            "object_splats": ObjectSplats(points, normals, _nearest_colors(points, start), obj),
            "object_poses": ObjectPoses(start.rotations, start.centers),
            "object_surface": ObjectSurface(
                torch.as_tensor(verts, dtype=torch.float32), torch.as_tensor(faces.copy())
            ),
            "object_distance": DistanceField(grid),
        }
    n_frames = len(clip)
    present = [*clip.hands, *(["object"] if clip.object is not None else [])]
    scene = Scene(
        K=torch.as_tensor(clip.K, dtype=torch.float32),
        width=clip.width,
        height=clip.height,
        hand_splats={side: HandSplats(model, hand) for side, (model, _) in canonical.items()},
        betas={side: betas for side, (_, betas) in canonical.items()},
        hand_poses={
            side: HandPoses(start.global_orient, start.hand_pose, start.wrist)
            for side, start in starts.items()
        },
        lighting=Lighting(present, n_frames) if lighting else None,
        **object_parts,
    )
    return SceneStart(scene, skipped)


def _canonical_hands(
    clip: Clip, models: Mapping[Side, HandModel], config: HandSplatsConfig
) -> dict[Side, tuple[HandModel, Tensor]]:
    """The right-handed model and start shape of each canonical hand."""
    right = models["right"]
    shapes: dict[Side, Tensor] = {}
    for side, track in clip.hands.items():
        betas = torch.as_tensor(track.betas, dtype=torch.float32)
        shapes[side] = betas if side == "right" else shared_betas(right, models["left"], betas)
    if not shapes:
        return {}
    if config.shared:
        return {"right": (right, likely_shape(list(shapes.values()), config.shape_error))}
    return {side: (right, likely_shape([betas], config.shape_error)) for side, betas in shapes.items()}


def likely_shape(estimates: Sequence[Tensor], error: float) -> Tensor:
    """The most likely betas [10] of one person given estimates of both hands, or of one.

    The paper takes the right hand's; two independent estimates are better averaged, and as betas have unit
    variance among people, an uncertain estimate lies too far out. How uncertain the mean is, both hands'
    difference tells.

    Args:
        estimates: one or two shapes [10].
        error: standard deviation of one estimate where there is no second; 0 takes estimates as they are.
    """
    mean = torch.stack(list(estimates)).mean(0)
    if error == 0.0:
        return mean
    variance = error**2
    if len(estimates) == 2:
        variance = float((estimates[0] - estimates[1]).square().mean()) / 4.0
    return mean / (1.0 + variance)


def _nearest_colors(points: np.ndarray, start: ObjectStart) -> np.ndarray:
    if start.colors is None:
        return np.full((len(points), 3), 0.5)
    _, index = scipy.spatial.cKDTree(start.points).query(points, k=min(3, len(start.points)))
    return start.colors[index].reshape(len(points), -1, 3).mean(1)

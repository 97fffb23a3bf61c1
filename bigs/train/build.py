"""A scene at its start values: canonical hands, the object's surface and its Gaussians, smoothed poses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy.spatial
import torch
import trimesh
from torch import Tensor

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.geometry.distance import DistanceField
from bigs.geometry.surface import (
    DistanceGrid,
    VisualHull,
    blend_with_points,
    convex_distance,
    empty_grid,
    extract_mesh,
    point_normals,
    silhouette_around_points,
)
from bigs.hand import HandModel, shared_betas
from bigs.models.hand_splats import HandSplats, HandSplatsConfig
from bigs.models.lighting import Lighting
from bigs.models.object_splats import ObjectSplats, ObjectSplatsConfig
from bigs.models.poses import HandPoses, ObjectPoses
from bigs.models.scene import ObjectSurface, Scene
from bigs.train.initial import (
    InitialConfig,
    ObjectStart,
    hand_in_camera,
    object_in_camera,
    smooth_hand,
    smooth_object,
)
from bigs.types import MASK_VALUES, Side

# Fewer points than this carry no surface.
_MIN_POINTS = 30


def usable_silhouettes(clip: Clip, start: ObjectStart) -> list[int]:
    """Frames whose silhouette may carve the object: it is visible, and its pose was measured.

    An interpolated pose carves what it should not; such frames serve only when there are hardly any others.
    """
    shown = [t for t in range(len(clip)) if clip.mask_areas["object"][t] > 0]
    trusted = [t for t in shown if start.trust[t] == 1.0]
    return trusted if len(trusted) >= min(len(shown), 5) else shown


def convex_surface(start: ObjectStart, config: InitialConfig) -> DistanceGrid:
    """The fallback: the convex hull of the points.

    Raises:
        InputError: the points span no volume.
    """
    size = (start.points.max(0) - start.points.min(0)).max()
    grid = empty_grid(
        start.points.min(0) - 0.1 * size, start.points.max(0) + 0.1 * size, config.surface_resolution
    )
    try:
        distance = convex_distance(grid.points(), start.points)
    except scipy.spatial.QhullError:
        raise InputError(
            "entities.object: pts.cano: expected points that span a volume, "
            f"found {len(start.points)} in a plane or fewer than four"
        ) from None
    return DistanceGrid(distance.reshape(grid.values.shape), grid.origin, grid.spacing)


def object_surface(
    clip: Clip, unknown: np.ndarray, start: ObjectStart, config: InitialConfig
) -> DistanceGrid:
    """The object's surface: visual hull of the masks blended with the points' planes.

    `unknown` [T, H, W] (bool) marks unlabelled occluders.

    Raises:
        ValueError: masks and poses leave nothing of the object, or too few points to tell.
    """
    usable = usable_silhouettes(clip, start)
    if not usable:
        raise ValueError("no frame shows the object")
    size = (start.points.max(0) - start.points.min(0)).max()
    lower, upper = start.points.min(0) - 0.25 * size, start.points.max(0) + 0.25 * size
    grid = empty_grid(lower, upper, config.surface_resolution)
    labels = np.stack([clip.mask(t) for t in usable])
    rotations, centers = start.rotations[usable].numpy(), start.centers[usable].numpy()
    # Whatever is not background may hide the object, so the object may be there.
    allowed = (labels != 0) | unknown[usable]
    silhouettes = [
        silhouette_around_points(mask, start.points @ rotation.T + center, clip.K)
        for mask, rotation, center in zip(allowed, rotations, centers, strict=True)
    ]
    agreeing = min(config.surface_agreeing, len(usable))
    hull = VisualHull(np.stack(silhouettes), clip.K, rotations, centers, agreeing)
    corners = grid.points()
    distance = hull.distance(corners, stop=config.surface_reach)
    points = start.points[hull.distance(start.points) < 0.25 * config.surface_reach]
    if len(points) < _MIN_POINTS:
        raise ValueError(f"only {len(points)} of {len(start.points)} points lie inside the silhouettes")
    # Beyond the points' convex hull only what nearly always shows as object stays: the far side of an object
    # that was never turned does, the space that a hand always covers does not.
    doubtful = np.flatnonzero(distance < config.surface_reach)
    shown = hull.share_seen(corners[doubtful], labels == MASK_VALUES["object"])
    beyond = convex_distance(corners[doubtful], points) - config.surface_margin
    distance[doubtful] = np.maximum(
        distance[doubtful], beyond - config.surface_reach * ((shown - config.surface_shown) / 0.1).clip(0.0)
    )
    carved = DistanceGrid(distance.reshape(grid.values.shape), grid.origin, grid.spacing)
    normals = point_normals(points, hull.outward(points, 0.5 * grid.spacing))
    return blend_with_points(carved, points, normals, config.surface_reach)


def build_scene(
    clip: Clip,
    unknown: np.ndarray,
    hand_models: Mapping[Side, HandModel],
    initial: InitialConfig,
    hand: HandSplatsConfig,
    obj: ObjectSplatsConfig,
    lighting: bool,
) -> tuple[Scene, list[str]]:
    """A scene at its start values, and what had to be replaced by something simpler on the way.

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
    notes: list[str] = []
    object_parts = dict.fromkeys(("object_splats", "object_poses", "object_surface", "object_distance"), None)
    if clip.object is not None:
        start = smooth_object(object_in_camera(clip, initial), initial.smooth_object)
        try:
            grid = object_surface(clip, unknown, start, initial)
            verts, faces = extract_mesh(grid)
        except (ValueError, scipy.spatial.QhullError) as reason:
            notes.append(f"object surface from masks: {reason}; the points' convex hull stands in for it")
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
    return scene, notes


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
        # The paper takes the right hand's shape for both; two independent estimates of one person's hands
        # are better averaged.
        return {"right": (right, torch.stack(list(shapes.values())).mean(0))}
    return {side: (right, betas) for side, betas in shapes.items()}


def sample_surface(verts: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """About `count` evenly spread surface points [N, 3] and their unit outward normals [N, 3]."""
    mesh = trimesh.Trimesh(verts, faces, process=False)
    points, face = trimesh.sample.sample_surface_even(mesh, count, seed=0)
    return np.asarray(points), np.asarray(mesh.face_normals[face])


def _nearest_colors(points: np.ndarray, start: ObjectStart) -> np.ndarray:
    if start.colors is None:
        return np.full((len(points), 3), 0.5)
    _, index = scipy.spatial.cKDTree(start.points).query(points, k=min(3, len(start.points)))
    return start.colors[index].reshape(len(points), -1, 3).mean(1)

"""Start values: the clip's estimates carried into camera space, smoothed, and given a surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import scipy.spatial
import torch
import trimesh
from torch import Tensor

from bigs.data.base import Clip, HandTrack
from bigs.geometry.distance import DistanceField
from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.geometry.smoothing import interpolated_frames, smooth_rotations, smooth_vectors
from bigs.geometry.surface import (
    DistanceGrid,
    VisualHull,
    blend_with_points,
    convex_distance,
    empty_grid,
    extract_mesh,
    inlier_points,
    point_normals,
    silhouette_distance,
)
from bigs.hand import HandModel, mirror_rotation, shared_betas
from bigs.models.hand_splats import HandSplats, HandSplatsConfig
from bigs.models.object_splats import ObjectSplats, ObjectSplatsConfig
from bigs.models.poses import HandPoses, ObjectPoses
from bigs.models.scene import ObjectSurface, Scene
from bigs.types import MASK_VALUES, Side


@dataclass(frozen=True)
class InitialConfig:
    """How the clip's estimates become start values."""

    # Width in frames of the robust smoothing of hand and object poses; wider than about 2 smears re-grasps.
    smooth_hands: float = 2.0
    smooth_object: float = 2.0
    # Trust in a frame that the estimator filled in by interpolation.
    interpolated_trust: float = 0.1
    # Cells along the longest side of the grid on which the object's surface is found.
    surface_resolution: int = 80
    # Share of a point's plane against the visual hull falls to nothing at this distance, metres.
    surface_reach: float = 0.016
    # The surface may leave the points' convex hull by this much, metres, and further only where the masks
    # show object in more than this share of the frames.
    surface_margin: float = 0.002
    surface_shown: float = 0.8


class HandStart(NamedTuple):
    """One hand in camera space, as poses of the canonical right hand."""

    global_orient: Tensor  # [T, 3, 3]
    hand_pose: Tensor  # [T, 15, 3, 3]
    wrist: Tensor  # [T, 3] metres, true camera space for either side
    trust: Tensor  # [T]


class ObjectStart(NamedTuple):
    """The object in camera space: x_cam = R p + centre for metric points p about their box's centre."""

    points: np.ndarray  # [N, 3] metres
    colors: np.ndarray | None
    rotations: Tensor  # [T, 3, 3]
    centers: Tensor  # [T, 3]
    trust: Tensor  # [T]


def hand_in_camera(
    track: HandTrack, cam_from_world: np.ndarray, model: HandModel, config: InitialConfig
) -> HandStart:
    """Carry a hand's estimates into camera space; nothing is smoothed yet.

    `model` is that side's own model: its rest wrist and mean pose are part of the track's convention.
    """
    to_cam = torch.as_tensor(cam_from_world, dtype=torch.float32)
    as_tensor = lambda array: torch.as_tensor(array, dtype=torch.float32)  # noqa: E731
    orient = to_cam[:, :3, :3] @ axis_angle_to_matrix(as_tensor(track.global_orient))
    pose = model.pose_matrices(as_tensor(track.hand_pose))
    wrist_world = model.rest_joints(as_tensor(track.betas))[0] + as_tensor(track.transl)
    wrist = (to_cam[:, :3, :3] @ wrist_world[..., None])[..., 0] + to_cam[:, :3, 3]
    if model.side == "left":
        orient, pose = mirror_rotation(orient), mirror_rotation(pose)
    return HandStart(orient, pose, wrist, _trust(track.valid, as_tensor(track.transl), config))


def object_in_camera(clip: Clip, config: InitialConfig) -> ObjectStart:
    """Carry the object's estimates into camera space, its points metric about their box's centre."""
    track = clip.object
    metric = track.points @ track.metric_from_canon[:3, :3].T + track.metric_from_canon[:3, 3]
    keep = inlier_points(metric)
    middle = 0.5 * (metric[keep].min(0) + metric[keep].max(0))
    to_cam = clip.cam_from_world
    rotations = to_cam[:, :3, :3] @ track.rotations
    centers_world = track.rotations @ middle + track.transl
    centers = np.einsum("tij,tj->ti", to_cam[:, :3, :3], centers_world) + to_cam[:, :3, 3]
    return ObjectStart(
        metric[keep] - middle,
        None if track.colors is None else track.colors[keep],
        torch.as_tensor(rotations, dtype=torch.float32),
        torch.as_tensor(centers, dtype=torch.float32),
        _trust(track.valid, torch.as_tensor(track.transl), config),
    )


def _trust(valid: np.ndarray, transl: Tensor, config: InitialConfig) -> Tensor:
    doubtful = interpolated_frames(transl) | ~torch.as_tensor(valid)
    return torch.where(doubtful, config.interpolated_trust, 1.0)


def smooth_hand(start: HandStart, sigma: float) -> HandStart:
    """Robustly smoothed rotations and position; the position as a ray and a log depth, whose noises differ."""
    pose = torch.stack(
        [smooth_rotations(start.hand_pose[:, j], start.trust, sigma) for j in range(15)], dim=1
    )
    return HandStart(
        smooth_rotations(start.global_orient, start.trust, sigma),
        pose,
        _smooth_positions(start.wrist, start.trust, sigma),
        start.trust,
    )


def smooth_object(start: ObjectStart, sigma: float) -> ObjectStart:
    """Robustly smoothed rotations and positions of the object."""
    return start._replace(
        rotations=smooth_rotations(start.rotations, start.trust, sigma),
        centers=_smooth_positions(start.centers, start.trust, sigma),
    )


def _smooth_positions(positions: Tensor, trust: Tensor, sigma: float) -> Tensor:
    depth = positions[:, 2:].log()
    rays = smooth_vectors(positions[:, :2] / positions[:, 2:], trust, sigma)
    depth = smooth_vectors(depth, trust, sigma).exp()
    return torch.cat([rays * depth, depth], dim=1)


def object_surface(
    clip: Clip, unknown: np.ndarray, start: ObjectStart, config: InitialConfig
) -> DistanceGrid:
    """The object's surface: visual hull of the masks blended with the points' planes.

    `unknown` [T, H, W] (bool) marks unlabelled occluders.
    """
    size = (start.points.max(0) - start.points.min(0)).max()
    lower, upper = start.points.min(0) - 0.25 * size, start.points.max(0) + 0.25 * size
    grid = empty_grid(lower, upper, config.surface_resolution)
    usable = [t for t in range(len(clip)) if clip.mask_areas["object"][t] > 0]
    labels = np.stack([clip.mask(t) for t in usable])
    # Whatever is not background may hide the object, so the object may be there.
    hull = VisualHull(
        np.stack(
            [silhouette_distance((frame != 0) | hiding) for frame, hiding in zip(labels, unknown[usable], strict=True)]
        ),
        clip.K,
        start.rotations[usable].numpy(),
        start.centers[usable].numpy(),
    )
    corners = grid.points()
    distance = hull.distance(corners, stop=config.surface_reach)
    points = start.points[hull.distance(start.points) < 0.25 * config.surface_reach]
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
) -> Scene:
    """A scene at its start values.

    Args:
        clip: the loaded clip.
        unknown: [T, H, W] bool, unlabelled occluders (see `background`).
        hand_models: both sides' models in their files' own conventions.
    """
    starts = {
        side: smooth_hand(
            hand_in_camera(track, clip.cam_from_world, hand_models[side], initial), initial.smooth_hands
        )
        for side, track in clip.hands.items()
    }
    canonical = _canonical_hands(clip, hand_models, hand)
    object_parts = dict.fromkeys(
        ("object_splats", "object_poses", "object_surface", "object_distance"), None
    )
    if clip.object is not None:
        start = smooth_object(object_in_camera(clip, initial), initial.smooth_object)
        grid = object_surface(clip, unknown, start, initial)
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
    return Scene(
        K=torch.as_tensor(clip.K, dtype=torch.float32),
        width=clip.width,
        height=clip.height,
        hand_splats={side: HandSplats(model, hand) for side, (model, _) in canonical.items()},
        betas={side: betas for side, (_, betas) in canonical.items()},
        hand_poses={
            side: HandPoses(start.global_orient, start.hand_pose, start.wrist)
            for side, start in starts.items()
        },
        **object_parts,
    )


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


def touching_frames(clip: Clip, side: Side, reach: int = 3) -> np.ndarray:
    """Frames [T] (bool) in which the masks of a hand and of the object come within `reach` pixels."""
    touching = np.zeros(len(clip), dtype=bool)
    square = np.ones((2 * reach + 1, 2 * reach + 1), dtype=bool)
    for t in range(len(clip)):
        if clip.mask_areas[side][t] and clip.mask_areas["object"][t]:
            labels = clip.mask(t)
            hand = scipy.ndimage.binary_dilation(labels == MASK_VALUES[side], square)
            touching[t] = bool((hand & (labels == MASK_VALUES["object"])).any())
    return touching

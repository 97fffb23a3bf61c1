"""The whole scene of a clip: canonical subjects, their poses, and the camera."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bigs.geometry.distance import DistanceField
from bigs.hand import HandModel, mirror_points
from bigs.models.grasps import Grasps
from bigs.models.hand_splats import CanonicalHand, HandSplats, pose_hand
from bigs.models.lighting import Lighting
from bigs.models.object_splats import CanonicalObject, ObjectSplats, pose_object
from bigs.models.poses import HandFrames, HandPoses, ObjectFrames, ObjectPoses
from bigs.types import SIDES, Entity, Gaussians, Side


@dataclass(frozen=True)
class ObjectSurface:
    """The object's surface in its own frame, metres at the initial size."""

    verts: Tensor  # [V, 3]
    faces: Tensor  # [F, 3]


class Scene(nn.Module):
    """Everything that is optimised, and nothing else.

    A hand is `canonical[side]`'s Gaussians under `hand_poses[side]`; with sharing on, both sides name the
    same canonical hand and the same shape.
    """

    def __init__(
        self,
        *,
        K: Tensor,
        width: int,
        height: int,
        hand_splats: Mapping[Side, HandSplats],
        betas: Mapping[Side, Tensor],
        hand_poses: Mapping[Side, HandPoses],
        object_splats: ObjectSplats | None,
        object_poses: ObjectPoses | None,
        object_surface: ObjectSurface | None,
        object_distance: DistanceField | None,
        lighting: Lighting | None,
    ) -> None:
        """
        Args:
            K: [3, 3] intrinsics of the full image, `width` x `height` pixels.
            hand_splats, betas: per canonical hand ("right" alone when shared); betas [10].
            hand_poses: per hand of the clip.
            object_splats, object_poses, object_surface, object_distance: all or none.
            lighting: None gives every Gaussian one colour for all frames.
        """
        super().__init__()
        self.register_buffer("K", K, persistent=False)
        self.width, self.height = width, height
        self.hand_splats = nn.ModuleDict(dict(hand_splats))
        self.betas = nn.ParameterDict({side: nn.Parameter(value) for side, value in betas.items()})
        self.base_betas = {side: value.clone() for side, value in betas.items()}
        self.hand_poses = nn.ModuleDict(dict(hand_poses))
        self.grasps = nn.ModuleDict(
            {
                side: Grasps(len(poses.base_orient), mirrored=side == "left")
                for side, poses in hand_poses.items()
            }
        )
        self.object_splats = object_splats
        self.object_poses = object_poses
        # Kept with what is trained: a prior may change it.
        self.register_buffer("surface_verts", None if object_surface is None else object_surface.verts)
        self.register_buffer("surface_faces", None if object_surface is None else object_surface.faces)
        self.object_distance = object_distance
        self.lighting = lighting

    @property
    def object_surface(self) -> ObjectSurface | None:
        if self.surface_verts is None:
            return None
        return ObjectSurface(self.surface_verts, self.surface_faces)

    def replace_surface(self, surface: ObjectSurface) -> None:
        """Give the object another surface, of any number of vertices."""
        self.surface_verts, self.surface_faces = surface.verts, surface.faces

    @property
    def sides(self) -> tuple[Side, ...]:
        return tuple(side for side in SIDES if side in self.hand_poses)

    @property
    def entities(self) -> tuple[Entity, ...]:
        return (*self.sides, "object") if self.object_splats is not None else self.sides

    @property
    def n_frames(self) -> int:
        first = next(iter(self.hand_poses.values())) if self.sides else self.object_poses
        return len(first.base_orient)

    def canonical_side(self, side: Side) -> Side:
        """Whose Gaussians and shape this side uses."""
        return side if side in self.hand_splats else next(iter(self.hand_splats))

    def hand_model(self, side: Side) -> HandModel:
        """The canonical (right-handed) model behind a side."""
        return self.hand_splats[self.canonical_side(side)].model

    def hand_betas(self, side: Side) -> Tensor:
        return self.betas[self.canonical_side(side)]

    def canonical(self, entities: Iterable[Entity]) -> dict[Entity, CanonicalHand | CanonicalObject]:
        """Evaluate the fields of `entities`, each field once."""
        evaluated: dict[Entity, CanonicalHand] = {}
        result: dict[Entity, CanonicalHand | CanonicalObject] = {}
        for entity in entities:
            if entity == "object":
                result[entity] = self.object_splats()
                continue
            owner = self.canonical_side(entity)
            if owner not in evaluated:
                evaluated[owner] = self.hand_splats[owner]()
            result[entity] = evaluated[owner]
        return result

    def hand_frames(self, side: Side, frames: Tensor) -> HandFrames:
        """Poses of the canonical hand at `frames` [B]; a left hand's wrist is seen in the mirror."""
        pose = self.hand_pose(side, frames)
        return pose._replace(wrist=mirror_points(pose.wrist)) if side == "left" else pose

    def hand_pose(self, side: Side, frames: Tensor) -> HandFrames:
        """The same with the wrist where it is; in a grasp the object carries the hand."""
        poses, grasps = self.hand_poses[side], self.grasps[side]
        held = grasps.held(frames)
        if not held.any():
            return poses(frames)
        carried, own = grasps(frames, self.object_frames(frames)), poses.start(frames)
        start = (
            torch.where(held.reshape(-1, *[1] * (a.ndim - 1)), a, b)
            for a, b in zip(carried, own, strict=True)
        )
        return poses(frames, HandFrames(*start), torch.where(held, grasps.slack, 1.0))

    def free_frames(self, side: Side) -> Tensor:
        """The frames in which a hand belongs to no grasp, rising."""
        return torch.nonzero(self.grasps[side].of_frame < 0).flatten()

    def object_frames(self, frames: Tensor) -> ObjectFrames:
        return self.object_poses(frames)

    def posed(self, entity: Entity, canonical: CanonicalHand | CanonicalObject, frames: Tensor) -> Gaussians:
        """Gaussians of one entity at `frames` [B], camera space and lit: means [B, N, 3], quats [B, N, 4]."""
        if entity == "object":
            posed = pose_object(canonical, self.object_frames(frames))
        else:
            pose = self.hand_frames(entity, frames)
            posed = pose_hand(self.hand_model(entity), canonical, self.hand_betas(entity), pose, entity)
        if self.lighting is None:
            return posed
        # Light has no say in how a hand bends.
        return self.lighting(entity, posed, frames, canonical.weights.detach())

    def hand_points(self, side: Side, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Vertices [B, V, 3] and 21 joints [B, 21, 3] of a hand in camera space, metres."""
        pose = self.hand_frames(side, frames)
        out = self.hand_model(side)(self.hand_betas(side), pose.hand_pose, pose.global_orient, pose.wrist)
        if side == "left":
            return mirror_points(out.vertices), mirror_points(out.joints)
        return out.vertices, out.joints

    def object_points(self, points: Tensor, frames: Tensor) -> Tensor:
        """Points [N, 3] of the object's own frame in camera space at `frames`: [B, N, 3]."""
        pose = self.object_frames(frames)
        return pose.scale * points @ pose.rotations.transpose(-1, -2) + pose.centers[:, None]

    def in_object_frame(self, points: Tensor, frames: Tensor) -> Tensor:
        """Camera points [B, N, 3] in the object's own frame (metres at the initial size)."""
        pose = self.object_frames(frames)
        return (points - pose.centers[:, None]) @ pose.rotations / pose.scale


def concatenate(parts: Iterable[Gaussians]) -> Gaussians:
    """Several subjects' Gaussians as one set; what has no batch axis in one and in another is repeated."""
    parts = list(parts)
    frames = parts[0].means.shape[0]
    return Gaussians(
        torch.cat([part.means for part in parts], dim=1),
        torch.cat([part.quats.expand(frames, *part.quats.shape[-2:]) for part in parts], dim=1),
        torch.cat([part.scales for part in parts]),
        torch.cat([part.opacities for part in parts]),
        torch.cat([part.colors for part in parts], dim=-2),
    )

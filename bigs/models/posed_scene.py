"""The poses of some frames, each computed once however many loss terms ask for it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from bigs.fused.posing import Posing, skin
from bigs.fused.touch import Group, Touch
from bigs.geometry.distance import WHOLE_HAND
from bigs.hand import Skeleton, mirror_points
from bigs.models.canonical import CanonicalHand, CanonicalObject
from bigs.models.hand_splats import rest_points
from bigs.models.poses import HandFrames, ObjectFrames
from bigs.models.posing import Covered, Part, hand_part, object_part, pose_parts
from bigs.types import Entity, Gaussians, Side

if TYPE_CHECKING:
    from bigs.models.scene import Scene

# Vertices of a fingertip that touch when it does.
_PAD = 5


class PosedScene:
    """A scene at some frames, differentiable; valid until a parameter changes."""

    def __init__(self, scene: Scene, frames: Tensor, of: PosedScene | None = None) -> None:
        """
        Args:
            scene: whose poses.
            frames: [B] indices.
            of: the scene at all frames, from which these are taken.
        """
        self._scene, self.frames, self._of = scene, frames, of
        self._hands: dict[Side, HandFrames] = {}
        self._skeletons: dict[Side, Skeleton] = {}

    def at(self, frames: Tensor) -> PosedScene:
        """Some frames [B] of these, which have to be the whole clip's; what both need is shared."""
        return PosedScene(self._scene, frames, self)

    @cached_property
    def object(self) -> ObjectFrames:
        """The object's poses."""
        if self._of is None:
            return self._scene.object_poses(self.frames)
        whole = self._of.object
        return ObjectFrames(whole.rotations[self.frames], whole.centers[self.frames], whole.scale)

    def hand(self, side: Side) -> HandFrames:
        """Poses of the canonical hand with the wrist where it is; in a grasp the object carries the hand."""
        if side not in self._hands:
            self._hands[side] = (
                self._own_hand(side)
                if self._of is None
                else HandFrames(*(part[self.frames] for part in self._of.hand(side)))
            )
        return self._hands[side]

    def canonical_hand(self, side: Side) -> HandFrames:
        """The same as poses of the right hand: a left hand's wrist is seen in the mirror."""
        pose = self.hand(side)
        return pose._replace(wrist=mirror_points(pose.wrist)) if side == "left" else pose

    def verts(self, side: Side) -> Tensor:
        """Vertices [B, V, 3] of a hand in camera space, metres."""
        return skin(self.posing(side))

    def joints(self, side: Side) -> Tensor:
        """The 21 joints [B, 21, 3] of a hand in camera space, metres."""
        joints = self._skeleton(side).joints
        joints = mirror_points(joints) if side == "left" else joints
        tips = self.posing(side, self._scene.hand_model(side).tip_vertex_ids)
        return torch.cat([joints, skin(tips)], dim=1)

    def object_points(self, points: Tensor) -> Tensor:
        """Points [N, 3] of the object's own frame in camera space: [B, N, 3]."""
        pose = self.object
        return pose.scale * points @ pose.rotations.transpose(-1, -2) + pose.centers[:, None]

    def in_object_frame(self, points: Tensor) -> Tensor:
        """Camera points [B, N, 3] in the object's own frame (metres at the initial size)."""
        pose = self.object
        return (points - pose.centers[:, None]) @ pose.rotations / pose.scale

    def touch(self, side: Side, carrier: ObjectFrames | None = None) -> Touch:
        """What touches the object's surface, metres: of the whole hand, then of each of its `fingertips`.

        The object has the poses `carrier`, or its own.
        """
        tips = (Group(_PAD, tip) for tip in self._scene.hand_model(side).fingertips)
        carrier = carrier or self.object
        return self._scene.object_distance.touch(self.posing(side), *carrier, (WHOLE_HAND, *tips))

    def posing(self, side: Side, vertices: Tensor | None = None) -> Posing:
        """What carries a hand's vertices, or some of them (indices), to camera space."""
        skeleton, pose = self._skeleton(side), self.hand(side).hand_pose
        posing = self._scene.hand_model(side).posing(skeleton, pose, vertices)
        return posing._replace(mirrored=side == "left")

    def posed(
        self, canonical: Mapping[Entity, CanonicalHand | CanonicalObject], labels: bool = False
    ) -> Gaussians:
        """Gaussians of some entities in camera space, lit: means [B, N, 3], quats [B, N, 4].

        With `labels`, colours go on with a channel for each entity, in the order of `canonical`.
        """
        lighting = self._scene.lighting
        parts = [self._part(entity, splats) for entity, splats in canonical.items()]
        return pose_parts(parts, None if lighting is None else lighting.clip, labels)

    def _part(self, entity: Entity, canonical: CanonicalHand | CanonicalObject) -> Part:
        if entity == "object":
            part = object_part(canonical, self.object)
        else:
            points = rest_points(canonical, self._scene.hand_betas(entity), self.hand(entity).hand_pose)
            part = hand_part(canonical, points, self._skeleton(entity).bone_transforms, entity)
        lighting = self._scene.lighting
        if lighting is None:
            return part
        resting = self._scene.splats(entity).base_points
        covered = Covered(lighting.occlusion[entity].at(resting)[self.frames], lighting.ambient[entity])
        return part.lit(canonical.weights, lighting.shade[entity][self.frames], covered)

    def _own_hand(self, side: Side) -> HandFrames:
        poses, grasps = self._scene.hand_poses[side], self._scene.grasps[side]
        grasped = grasps.covers(self.frames).any()
        return poses(self.frames, grasps(self.object) if grasped else None)

    def _skeleton(self, side: Side) -> Skeleton:
        """The canonical hand's bones."""
        if side not in self._skeletons:
            if self._of is None:
                model, betas = self._scene.hand_model(side), self._scene.hand_betas(side)
                pose = self.canonical_hand(side)
                self._skeletons[side] = model.skeleton(betas, pose.hand_pose, pose.global_orient, pose.wrist)
            else:
                whole = self._of._skeleton(side)
                self._skeletons[side] = Skeleton(
                    whole.shaped, whole.joints[self.frames], whole.bone_transforms[self.frames]
                )
        return self._skeletons[side]

"""The whole scene of a clip: canonical subjects, their poses, and the camera."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, MutableMapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bigs.fused.posing import skin
from bigs.geometry.distance import DistanceField
from bigs.hand import HandModel, mirror_points
from bigs.models.canonical import CanonicalHand, CanonicalObject
from bigs.models.grasps import Grasps
from bigs.models.hand_detail import HandDetail
from bigs.models.hand_splats import HandSplats
from bigs.models.lighting import Lighting
from bigs.models.object_detail import ObjectDetail
from bigs.models.object_splats import ObjectSplats
from bigs.models.posed_scene import PosedScene
from bigs.models.poses import HandFrames, HandPoses, ObjectPoses
from bigs.types import SIDES, Entity, Side


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

    K: Tensor
    surface_verts: Tensor | None
    surface_faces: Tensor | None
    # Modules' own containers, typed by what they hold.
    hand_splats: MutableMapping[Side, HandSplats | HandDetail]
    hand_poses: MutableMapping[Side, HandPoses]
    grasps: MutableMapping[Side, Grasps]
    betas: MutableMapping[Side, nn.Parameter]
    object_splats: ObjectSplats | ObjectDetail | None

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
        self.hand_splats = nn.ModuleDict(hand_splats)  # type: ignore[assignment,arg-type]
        self.betas = nn.ParameterDict(  # type: ignore[assignment]
            {side: nn.Parameter(value) for side, value in betas.items()}
        )
        self.base_betas = {side: value.clone() for side, value in betas.items()}
        self.hand_poses = nn.ModuleDict(hand_poses)  # type: ignore[assignment,arg-type]
        self.grasps = nn.ModuleDict(  # type: ignore[assignment]
            {
                side: Grasps(len(poses.base_orient), mirrored=side == "left")
                for side, poses in hand_poses.items()
            }
        )
        self.object_splats = object_splats
        self.object_poses = object_poses
        # Stored with the trained values, since completion may change it.
        self.register_buffer("surface_verts", None if object_surface is None else object_surface.verts)
        self.register_buffer("surface_faces", None if object_surface is None else object_surface.faces)
        self.object_distance = object_distance
        self.lighting = lighting
        # The clip's files show black + brightness * what the scene is fitted to.
        self.black, self.brightness = 0.0, 1.0

    @property
    def object_surface(self) -> ObjectSurface | None:
        """The object's surface as it is now; None without an object."""
        if self.surface_verts is None:
            return None
        return ObjectSurface(self.surface_verts, self.surface_faces)

    def replace_surface(self, surface: ObjectSurface) -> None:
        """Give the object another surface, of any number of vertices."""
        self.surface_verts, self.surface_faces = surface.verts, surface.faces

    @property
    def sides(self) -> tuple[Side, ...]:
        """The hands that there are."""
        return tuple(side for side in SIDES if side in self.hand_poses)

    @property
    def entities(self) -> tuple[Entity, ...]:
        """The hands that there are, then the object if there is one."""
        return (*self.sides, "object") if self.object_splats is not None else self.sides

    @property
    def n_frames(self) -> int:
        """T, the number of the clip's frames."""
        first = next(iter(self.hand_poses.values())) if self.sides else self.object_poses
        return len(first.base_orient)

    def canonical_side(self, side: Side) -> Side:
        """Whose Gaussians and shape this side uses."""
        return side if side in self.hand_splats else next(iter(self.hand_splats))

    def hand_model(self, side: Side) -> HandModel:
        """The canonical (right-handed) model behind a side."""
        return self.hand_splats[self.canonical_side(side)].model

    def hand_betas(self, side: Side) -> Tensor:
        """The shape [10] of a side, which both sides share where they share the hand."""
        return self.betas[self.canonical_side(side)]

    def splats(self, entity: Entity) -> HandSplats | HandDetail | ObjectSplats | ObjectDetail:
        """The Gaussians of a subject that there is, in its own space; a hand's may be both sides'."""
        return self.object_splats if entity == "object" else self.hand_splats[self.canonical_side(entity)]

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

    def at(self, frames: Tensor) -> PosedScene:
        """Hands and object at `frames` [B]."""
        return PosedScene(self, frames)

    def hand_verts(self, side: Side, poses: HandFrames) -> Tensor:
        """Vertices [B, V, 3] of a hand in any poses of a side [B], in camera space, metres."""
        model, betas = self.hand_model(side), self.hand_betas(side)
        wrist = mirror_points(poses.wrist) if side == "left" else poses.wrist
        skeleton = model.skeleton(betas, poses.hand_pose, poses.global_orient, wrist)
        return skin(model.posing(skeleton, poses.hand_pose)._replace(mirrored=side == "left"))

    def free_frames(self, side: Side) -> Tensor:
        """Indices [F] of the frames in which a hand belongs to no grasp, rising."""
        return torch.nonzero(self.grasps[side].of_frame < 0).flatten()

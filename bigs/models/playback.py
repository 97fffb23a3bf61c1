"""A finished reconstruction as plain tensors: any frame can be shown without the clip or the hand model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bigs.checks import InputError
from bigs.geometry.rotations import matrix_to_axis_angle
from bigs.hand import mirror_axis_angle, mirror_points
from bigs.hand.lbs import pose_corrective
from bigs.models.canonical import CanonicalHand, CanonicalObject
from bigs.models.lighting import LEVELS, Lighting
from bigs.models.poses import ObjectFrames
from bigs.models.posing import Covered, Part, hand_part, object_part, pose_parts
from bigs.models.scene import Scene
from bigs.names import check_name
from bigs.types import USUAL_FPS, Entity, Gaussians, HandObjectTrajectory, Side

# Fields with a value per frame.
_MOVING_HAND = (
    *("joints", "verts", "bones", "hand_pose", "shade", "occlusion"),
    *("global_orient_aa", "hand_pose_aa", "transl"),
    *("grasp", "grasp_certainty"),
)
_MOVING_OBJECT = ("rotations", "centers", "shade", "occlusion")


class Grasp(NamedTuple):
    """A stretch of frames over which a hand holds the object."""

    start: int  # first frame
    stop: int  # the frame after the last
    certainty: float  # in [0, 1], mean over its frames


@dataclass(frozen=True)
class HandPlayback:
    """One hand over the clip."""

    joints: Tensor  # [T, 21, 3] camera space, metres
    verts: Tensor  # [T, V, 3]
    faces: Tensor  # [F, 3]
    bones: Tensor  # [T, 16, 4, 4] of the canonical (right) hand, mirrored camera for a left hand
    hand_pose: Tensor  # [T, 15, 3, 3] finger rotations of the canonical hand
    splats: CanonicalHand  # points already in the clip's shape
    shade: Tensor  # [T, 4 + 16] see `lighting`
    occlusion: Tensor  # [T, N] uint8: share of the sky in parts of `LEVELS`, see `lighting`
    ambient: Tensor  # [3] see `lighting`
    # The same poses in that side's own MANO convention, x_cam = MANO(orient, pose, betas) + transl
    # about the rest wrist joint; a left hand's model is the mirrored right one.
    global_orient_aa: Tensor  # [T, 3]
    hand_pose_aa: Tensor  # [T, 15, 3] relative to the model's mean pose
    transl: Tensor  # [T, 3] metres
    betas: Tensor  # [10]
    v_posed: Tensor  # [V, 3] or [T, V, 3]: shape and pose correctives, not skinned
    # What is needed to pose the mesh again (see `repose`), of the canonical hand as `bones` are.
    lbs_weights: Tensor  # [V, 16]
    rest_joints: Tensor  # [16, 3] in the clip's shape
    tip_vertex_ids: Tensor  # [5] thumb, index, middle, ring, pinky
    grasp: Tensor  # [T] number of the grasp in which the object carries the hand, -1 for none
    grasp_certainty: Tensor  # [T] in [0, 1], certainty of the grasp; 0 outside grasps

    def grasps(self) -> list[Grasp]:
        """The grasps, in order."""
        numbers = self.grasp.tolist()
        edges = [t for t in range(1, len(numbers)) if numbers[t] != numbers[t - 1]]
        return [
            Grasp(start, stop, float(self.grasp_certainty[start:stop].mean()))
            for start, stop in pairwise([0, *edges, len(numbers)])
            if numbers[start] >= 0
        ]


@dataclass(frozen=True)
class ObjectPlayback:
    """The object over the clip: x_cam = scale * R x + centre."""

    rotations: Tensor  # [T, 3, 3]
    centers: Tensor  # [T, 3]
    scale: Tensor  # []
    verts: Tensor  # [V, 3] own frame, metres at the initial size
    faces: Tensor  # [F, 3]
    splats: CanonicalObject
    shade: Tensor  # [T, 4 + 16]
    occlusion: Tensor  # [T, N] uint8
    ambient: Tensor  # [3]


@dataclass(frozen=True)
class Playback:
    """Everything a renderer or an exporter needs.

    Raises:
        InputError: a name that could not name a file.
    """

    name: str  # names files; see `bigs.names.check_name`
    frame_names: tuple[str, ...]
    K: Tensor  # [3, 3]
    width: int
    height: int
    normalize_shift: tuple[float, ...]  # [3] of the clip's file; places HOLD's scaled space
    light: Tensor | None  # [8, 3] the clip's light (see `lighting`); None: colours are fixed
    hands: dict[Side, HandPlayback]
    object: ObjectPlayback | None
    fps: float = USUAL_FPS  # frames a second
    black: float = 0.0  # what the clip's files have for black; `splats` hold what is added to it

    def __post_init__(self) -> None:
        check_name("the scene's name", self.name)

    @property
    def entities(self) -> tuple[Entity, ...]:
        """The hands that there are, then the object if there is one."""
        return (*self.hands, "object") if self.object is not None else tuple(self.hands)

    def __len__(self) -> int:
        return len(self.frame_names)

    @property
    def shares_hand(self) -> bool:
        """Whether both sides, if there are both, show the same canonical Gaussians."""
        points = [hand.splats.points for hand in self.hands.values()]
        return len(points) < 2 or torch.equal(points[0], points[1])

    def canonical(self, entity: Entity) -> Gaussians:
        """An entity's Gaussians [N, ...] before posing: a hand's in its shaped rest pose (right-handed)."""
        if entity == "object":
            splats, means = self.object.splats, self.object.splats.means
        else:
            splats, means = self.hands[entity].splats, self.hands[entity].splats.points
        return Gaussians(means, splats.quats, splats.scales, splats.opacities, splats.colors + self.black)

    def gaussians(self, frames: Iterable[int], entities: Iterable[Entity] | None = None) -> Gaussians:
        """Gaussians of some frames in their camera's space: means [B, N, 3], quats [B, N, 4], lit colours.

        Raises:
            InputError: a frame that the clip has not.
        """
        index = self._index(frames)
        chosen = self.entities if entities is None else entities
        posed = pose_parts((self._part(entity, index) for entity in chosen), self.light)
        return posed._replace(colors=posed.colors + self.black)

    def at(self, frames: Iterable[int]) -> Playback:
        """Some frames as a playback of their own.

        Raises:
            InputError: a frame that the clip has not.
        """
        index = self._index(frames)
        hands, obj = dict(self.hands), self.object
        for side, hand in hands.items():
            moving = {name: getattr(hand, name)[index] for name in _MOVING_HAND}
            if hand.v_posed.ndim == 3:
                moving["v_posed"] = hand.v_posed[index]
            hands[side] = replace(hand, **moving)
        if obj is not None:
            obj = replace(obj, **{name: getattr(obj, name)[index] for name in _MOVING_OBJECT})
        names = tuple(self.frame_names[t] for t in index.tolist())
        return replace(self, frame_names=names, hands=hands, object=obj)

    def _index(self, frames: Iterable[int]) -> Tensor:
        numbers = [int(frame) for frame in frames]
        for frame in numbers:
            if not 0 <= frame < len(self):
                raise InputError(f"frames: expected numbers from 0 to {len(self) - 1}, found {frame}")
        return torch.tensor(numbers, dtype=torch.int64)

    def _part(self, entity: Entity, index: Tensor) -> Part:
        subject = self.object if entity == "object" else self.hands[entity]
        if entity == "object":
            frames = ObjectFrames(subject.rotations[index], subject.centers[index], subject.scale)
            part = object_part(subject.splats, frames)
        else:
            points = subject.splats.points
            if subject.splats.posedirs is not None:
                points = points + pose_corrective(subject.splats.posedirs, subject.hand_pose[index])
            part = hand_part(subject.splats, points, subject.bones[index], entity)
        if self.light is None:
            return part
        covered = Covered(subject.occlusion[index].to(subject.ambient) / LEVELS, subject.ambient)
        return part.lit(subject.splats.weights, subject.shade[index], covered)

    def trajectory(self) -> HandObjectTrajectory:
        """Meshes and joints of every frame, camera space, metres."""
        verts = None
        if self.object is not None:
            obj = self.object
            verts = (obj.scale * obj.verts @ obj.rotations.transpose(-1, -2) + obj.centers[:, None]).numpy()
        return HandObjectTrajectory(
            name=self.name,
            frame_names=self.frame_names,
            joints={side: hand.joints.numpy() for side, hand in self.hands.items()},
            verts={side: hand.verts.numpy() for side, hand in self.hands.items()},
            faces={side: hand.faces.numpy() for side, hand in self.hands.items()},
            object_verts=verts,
            object_faces=None if self.object is None else self.object.faces.numpy(),
        )


@torch.no_grad()
def record(
    scene: Scene,
    name: str,
    frame_names: tuple[str, ...],
    normalize_shift: Sequence[float] | np.ndarray,
    fps: float = USUAL_FPS,
) -> Playback:
    """Evaluate a scene once and keep what is needed to show it.

    Args:
        scene: stays as it is.
        name: of the clip; names files.
        frame_names: T names.
        normalize_shift: [3] of the clip, see `Playback`.
        fps: frames a second of the clip.
    """
    frames = torch.arange(scene.n_frames)
    canonical = {
        entity: splats._replace(colors=splats.colors * scene.brightness)
        for entity, splats in scene.canonical(scene.entities).items()
    }
    hands: dict[Side, HandPlayback] = {}
    lighting = Lighting(scene.entities, scene.n_frames) if scene.lighting is None else scene.lighting
    shade = {entity: value.detach().clone() for entity, value in lighting.shade.items()}
    ambient = {entity: value.detach().clone() for entity, value in lighting.ambient.items()}
    covered = {
        entity: lighting.occlusion[entity].at(scene.splats(entity).base_points) for entity in scene.entities
    }
    occlusion = {entity: (LEVELS * shares).round().to(torch.uint8) for entity, shares in covered.items()}
    for side in scene.sides:
        model, betas = scene.hand_model(side), scene.hand_betas(side)
        pose = scene.at(frames).canonical_hand(side)
        verts, joints = scene.at(frames).verts(side), scene.at(frames).joints(side)
        splats = canonical[side]
        orient, fingers = matrix_to_axis_angle(pose.global_orient), model.pose_axis_angle(pose.hand_pose)
        transl = pose.wrist - model.rest_joints(betas)[0]
        v_posed = model.rest_vertices(betas)
        if model.has_posedirs:
            v_posed = v_posed + model.corrective(pose.hand_pose)
        if side == "left":
            orient, fingers = mirror_axis_angle(orient), mirror_axis_angle(fingers)
            transl, v_posed = mirror_points(transl), mirror_points(v_posed)
        hands[side] = HandPlayback(
            joints,
            verts,
            model.faces_of(side),
            model(betas, pose.hand_pose, pose.global_orient, pose.wrist).bone_transforms,
            pose.hand_pose,
            splats._replace(
                points=splats.points + splats.shapedirs @ betas, shapedirs=splats.shapedirs[..., :0]
            ),
            shade[side],
            occlusion[side],
            ambient[side],
            orient,
            fingers,
            transl,
            betas.detach().clone(),
            v_posed,
            model.lbs_weights,
            model.rest_joints(betas),
            model.tip_vertex_ids,
            scene.grasps[side].of_frame.clone(),
            scene.grasps[side].certainty.clone(),
        )
    obj = None
    if scene.object_splats is not None:
        placed = scene.at(frames).object
        surface = scene.object_surface
        obj = ObjectPlayback(
            placed.rotations,
            placed.centers,
            placed.scale,
            surface.verts,
            surface.faces,
            canonical["object"],
            shade["object"],
            occlusion["object"],
            ambient["object"],
        )
    return Playback(
        name,
        frame_names,
        scene.K,
        scene.width,
        scene.height,
        tuple(map(float, normalize_shift)),
        None if scene.lighting is None else scene.lighting.clip.detach().clone(),
        hands,
        obj,
        fps,
        scene.black,
    )

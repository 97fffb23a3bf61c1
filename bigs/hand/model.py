"""`HandModel`: a MANO-form hand (template, shape, skeleton, skinning) as a module without parameters."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from bigs.checks import check_shape
from bigs.fused.posing import Posing, skin
from bigs.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from bigs.hand.lbs import forward_kinematics, pose_corrective, shape_vertices
from bigs.hand.mirror import mirror_axis_angle, mirror_points
from bigs.types import Side

# MANO's joint order: wrist, then three joints each of index, middle, pinky, ring and thumb.
MANO_PARENTS: tuple[int, ...] = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
# Of the four fingers, not of the thumb.
_OUTERMOST = (3, 6, 9, 12)
JOINT_NAMES: tuple[str, ...] = (
    "wrist",
    *(f"{finger}{i}" for finger in ("index", "middle", "pinky", "ring", "thumb") for i in (1, 2, 3)),
    *(f"{finger}_tip" for finger in ("thumb", "index", "middle", "ring", "pinky")),
)


class HandOutput(NamedTuple):
    """A posed hand in each of T frames; metres, in the frame that the wrist was given in."""

    vertices: Tensor  # [T, V, 3]
    joints: Tensor  # [T, 21, 3] 16 joints in MANO order, then tips of thumb, index, middle, ring, pinky
    bone_transforms: Tensor  # [T, 16, 4, 4] shaped rest pose to posed


class Skeleton(NamedTuple):
    """A hand's shape and its bones in each of T frames."""

    shaped: Tensor  # [V, 3] rest vertices, before any pose corrective
    joints: Tensor  # [T, 16, 3] in the frame that the wrist was given in
    bone_transforms: Tensor  # [T, 16, 4, 4] shaped rest pose to posed


class HandModel(nn.Module):
    """One hand: rest shape, joint tree and skinning.

    Everything is a buffer, so `.to()` and `.double()` work; nothing is saved in a state dict, because model
    files are usually licensed and belong to the user, not to a checkpoint.

    Attributes:
        side: which hand this is.
        v_template: [V, 3] rest vertices of the mean shape, metres; axes as MANO's (right hand: fingers -x,
            thumb +z, palm -y).
        faces: [F, 3] long, outward winding.
        shapedirs: [V, 3, 10] metres per unit of shape.
        posedirs: [V, 3, 135] pose correctives, metres.
        J_regressor: [16, V] joints from rest vertices.
        parents: the joint tree, root -1.
        lbs_weights: [V, 16] skinning weights, rows sum to 1.
        hands_mean: [15, 3] mean finger pose, axis-angle.
        tip_vertex_ids: [5] long, thumb, index, middle, ring, pinky.
    """

    v_template: Tensor
    faces: Tensor
    shapedirs: Tensor
    posedirs: Tensor
    J_regressor: Tensor
    lbs_weights: Tensor
    hands_mean: Tensor
    tip_vertex_ids: Tensor

    def __init__(
        self,
        side: Side,
        *,
        v_template: np.ndarray | Tensor,
        faces: np.ndarray | Tensor,
        shapedirs: np.ndarray | Tensor,
        posedirs: np.ndarray | Tensor,
        J_regressor: np.ndarray | Tensor,
        lbs_weights: np.ndarray | Tensor,
        hands_mean: np.ndarray | Tensor,
        tip_vertex_ids: np.ndarray | Tensor,
        parents: tuple[int, ...] = MANO_PARENTS,
    ) -> None:
        super().__init__()
        self.side: Side = side
        self.parents = tuple(parents)
        floats = {
            "v_template": v_template,
            "shapedirs": shapedirs,
            "posedirs": posedirs,
            "J_regressor": J_regressor,
            "lbs_weights": lbs_weights,
            "hands_mean": hands_mean,
        }
        for name, values in floats.items():
            self.register_buffer(name, _tensor(values, torch.float32), persistent=False)
        self.register_buffer("faces", _tensor(faces, torch.int64), persistent=False)
        self.register_buffer("tip_vertex_ids", _tensor(tip_vertex_ids, torch.int64), persistent=False)
        # Most other models have no correctives, and the product with zeros would be the largest cost of a
        # pose.
        self.has_posedirs = bool(self.posedirs.any())

    @cached_property
    def fingertips(self) -> tuple[tuple[int, ...], ...]:
        """Vertices that most follow the outermost segments of index, middle, pinky and ring."""
        leading = self.lbs_weights.argmax(dim=1)
        tips = (tuple((leading == joint).nonzero()[:, 0].tolist()) for joint in _OUTERMOST)
        # A model may skin a finger without its outermost joint.
        return tuple(tip for tip in tips if tip)

    def faces_of(self, side: Side) -> Tensor:
        """Faces [F, 3] that look outwards on this hand as that side shows it: a mirror turns them around."""
        return self.faces if side == self.side else self.faces.flip(-1)

    def rest_vertices(self, betas: Tensor) -> Tensor:
        """Vertices [..., V, 3] of the shape `betas` [..., 10] in the rest pose, metres."""
        check_shape("betas", betas, ("...", self.shapedirs.shape[-1]))
        return shape_vertices(self.v_template, self.shapedirs, betas)

    def rest_joints(self, betas: Tensor) -> Tensor:
        """Joints [..., 16, 3] of the shape `betas` [..., 10] in the rest pose, metres."""
        return self.J_regressor @ self.rest_vertices(betas)

    def rest_wrist(self, betas: np.ndarray) -> np.ndarray:
        """The wrist joint [3] of the shape `betas` [10] in the rest pose, metres, in float64."""
        shaped = self.v_template.double() + self.shapedirs.double() @ torch.as_tensor(betas).double()
        return (self.J_regressor.double()[0] @ shaped).numpy()

    def corrective(self, hand_pose: Tensor) -> Tensor:
        """Offsets [T, V, 3] that finger rotations `hand_pose` [T, 15, 3, 3] add before skinning, metres."""
        return pose_corrective(self.posedirs, hand_pose)

    def forward(self, betas: Tensor, hand_pose: Tensor, global_orient: Tensor, wrist: Tensor) -> HandOutput:
        """Pose the hand; the wrist joint lands exactly at `wrist`: x = R (v - J0) + wrist.

        Args:
            betas: [10], or [T, 10].
            hand_pose: [T, 15, 3, 3] full finger rotations; no mean pose is added (see `pose_matrices`).
            global_orient: [T, 3, 3] rotation of the wrist, about the wrist joint.
            wrist: [T, 3] metres.

        Returns:
            Vertices, 21 joints and bone transforms in the frame of `wrist`.

        Raises:
            InputError: a shape that does not fit.
        """
        fingers = len(self.parents) - 1
        check_shape("hand_pose", hand_pose, ("T", fingers, 3, 3))
        check_shape("global_orient", global_orient, (len(hand_pose), 3, 3))
        check_shape("wrist", wrist, (len(hand_pose), 3))
        if getattr(betas, "ndim", 1) != 1:
            check_shape("betas", betas, (len(hand_pose), self.shapedirs.shape[-1]))
        skeleton = self.skeleton(betas, hand_pose, global_orient, wrist)
        vertices = self.skin(skeleton, hand_pose)
        joints = torch.cat([skeleton.joints, vertices[:, self.tip_vertex_ids]], dim=1)
        return HandOutput(vertices, joints, skeleton.bone_transforms)

    def skeleton(self, betas: Tensor, hand_pose: Tensor, global_orient: Tensor, wrist: Tensor) -> Skeleton:
        """The bones alone, without skinning.

        Args:
            betas: [10], or [T, 10].
            hand_pose: [T, 15, 3, 3].
            global_orient: [T, 3, 3].
            wrist: [T, 3] metres.
        """
        shaped = self.rest_vertices(betas)
        rotations = torch.cat([global_orient[:, None], hand_pose], dim=1)
        return Skeleton(
            shaped, *forward_kinematics(rotations, self.J_regressor @ shaped, self.parents, wrist)
        )

    def skin(self, skeleton: Skeleton, hand_pose: Tensor, vertices: Tensor | None = None) -> Tensor:
        """Vertices [T, V, 3] of a posed skeleton, or of some `vertices` (indices) only."""
        return skin(self.posing(skeleton, hand_pose, vertices))

    def posing(self, skeleton: Skeleton, hand_pose: Tensor, vertices: Tensor | None = None) -> Posing:
        """The same before it is carried out: what carries vertices to their frames."""
        some = slice(None) if vertices is None else vertices
        rest = skeleton.shaped[..., some, :]
        if self.has_posedirs:
            rest = rest + pose_corrective(self.posedirs[some], hand_pose)
        return Posing(rest, self.lbs_weights[some], skeleton.bone_transforms)

    def pose_matrices(self, hand_pose_aa: Tensor) -> Tensor:
        """Finger rotations [..., 15, 3, 3] of mean-relative axis-angle [..., 15, 3] (flat_hand_mean=False).

        The mean pose is added to the rotation vectors, as the datasets' hand layers do, not composed.

        Raises:
            InputError: another shape.
        """
        check_shape("hand_pose", hand_pose_aa, ("...", len(self.parents) - 1, 3))
        return axis_angle_to_matrix(hand_pose_aa + self.hands_mean)

    def pose_axis_angle(self, hand_pose: Tensor) -> Tensor:
        """The mean-relative axis-angle [..., 15, 3] of finger rotations [..., 15, 3, 3].

        Raises:
            InputError: another shape.
        """
        check_shape("hand_pose", hand_pose, ("...", len(self.parents) - 1, 3, 3))
        return matrix_to_axis_angle(hand_pose) - self.hands_mean

    def mirrored(self) -> HandModel:
        """The other hand: everything reflected in x = 0, faces still outward, same dtype and device."""
        signs = self.v_template.new_tensor([-1.0, 1.0, 1.0])
        # vec(S R S - I) = (s s^T) * vec(R - I), and offsets are reflected too.
        rotation_signs = torch.outer(signs, signs).reshape(1, 1, 9).repeat(1, 1, len(self.parents) - 1)
        return HandModel(
            "left" if self.side == "right" else "right",
            v_template=mirror_points(self.v_template),
            faces=self.faces.flip(-1),
            shapedirs=self.shapedirs * signs[:, None],
            posedirs=self.posedirs * signs[:, None] * rotation_signs,
            J_regressor=self.J_regressor,
            lbs_weights=self.lbs_weights,
            hands_mean=mirror_axis_angle(self.hands_mean),
            tip_vertex_ids=self.tip_vertex_ids,
            parents=self.parents,
        )


def _tensor(values: np.ndarray | Tensor, dtype: torch.dtype) -> Tensor:
    """A tensor of its own: arrays become `dtype`, tensors keep theirs."""
    return values.detach().clone() if isinstance(values, Tensor) else torch.tensor(values, dtype=dtype)

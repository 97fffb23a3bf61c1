"""A reconstruction in other poses: fingers bent, hands and object moved, without the hand model's file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from bigs.checks import check_choice, check_shape
from bigs.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from bigs.hand import JOINT_NAMES, MANO_PARENTS, mirror_axis_angle, mirror_points, skin_points
from bigs.hand.lbs import forward_kinematics
from bigs.models.playback import HandPlayback, ObjectPlayback
from bigs.types import Side

# The three joints of each finger within `hand_pose`, from the knuckle outwards.
FINGERS: dict[str, tuple[int, ...]] = {
    finger: tuple(JOINT_NAMES.index(f"{finger}{i}") - 1 for i in (1, 2, 3))
    for finger in ("thumb", "index", "middle", "ring", "pinky")
}


def wrist_of(hand: HandPlayback) -> tuple[Tensor, Tensor]:
    """Orientation [T, 3, 3] and place [T, 3] of the canonical hand's wrist, in the mirror for a left hand."""
    turn = hand.bones[:, 0, :3, :3]
    return turn, turn @ hand.rest_joints[0] + hand.bones[:, 0, :3, 3]


def repose(
    hand: HandPlayback, side: Side, hand_pose: Tensor, global_orient: Tensor, wrist: Tensor
) -> HandPlayback:
    """The hand in other poses; shape, Gaussians and, frame by frame, shade and occlusion stay.

    Args:
        hand: T frames.
        side: which hand it is.
        hand_pose: [T, 15, 3, 3] finger rotations of the canonical (right) hand.
        global_orient: [T, 3, 3] as `wrist_of` gives it.
        wrist: [T, 3] likewise, metres.

    Returns:
        A hand whose every field fits the new poses, except that the mesh keeps the pose correctives it had.
        (The Gaussians' are evaluated anew.)

    Raises:
        InputError: another shape.
    """
    check_shape("hand_pose", hand_pose, ("T", 15, 3, 3))
    check_shape("global_orient", global_orient, (len(hand_pose), 3, 3))
    check_shape("wrist", wrist, (len(hand_pose), 3))
    rotations = torch.cat([global_orient[:, None], hand_pose], dim=1)
    joints, bones = forward_kinematics(rotations, hand.rest_joints, MANO_PARENTS, wrist)
    left = side == "left"
    rest = mirror_points(hand.v_posed) if left else hand.v_posed
    verts = skin_points(rest, hand.lbs_weights, bones)
    joints = torch.cat([joints, verts[:, hand.tip_vertex_ids]], dim=1)
    orient, before = matrix_to_axis_angle(global_orient), matrix_to_axis_angle(hand.hand_pose)
    fingers = matrix_to_axis_angle(hand_pose)
    if left:
        verts, joints = mirror_points(verts), mirror_points(joints)
        orient, fingers, before = map(mirror_axis_angle, (orient, fingers, before))
    # Rest joints are the right hand's; `transl` is the wrist's place less its place at rest.
    transl = joints[:, 0] - (mirror_points(hand.rest_joints[0]) if left else hand.rest_joints[0])
    # Stored vectors are relative to the mean pose.
    return replace(
        hand,
        joints=joints,
        verts=verts,
        bones=bones,
        hand_pose=hand_pose,
        global_orient_aa=orient,
        hand_pose_aa=fingers - (before - hand.hand_pose_aa),
        transl=transl,
    )


def bend_fingers(hand: HandPlayback, side: Side, degrees: Mapping[str, float]) -> HandPlayback:
    """Bend fingers further towards the palm, in every frame.

    Args:
        hand: to bend.
        side: which hand it is.
        degrees: a name of `FINGERS` -> by how much each of its three joints is bent; negative stretches.

    Raises:
        InputError: a finger that no hand has.
    """
    for finger in degrees:
        check_choice("finger", finger, FINGERS)
    pose = hand.hand_pose.clone()
    for finger, angle in degrees.items():
        for joint, axis in zip(FINGERS[finger], _bending_axes(hand, finger), strict=True):
            pose[:, joint] = pose[:, joint] @ axis_angle_to_matrix(axis * torch.deg2rad(torch.tensor(angle)))
    return repose(hand, side, pose, *wrist_of(hand))


def turn_object(obj: ObjectPlayback, rotation: Tensor) -> ObjectPlayback:
    """Turn the object by `rotation` [3, 3], in its own axes about the middle of its mesh, in every frame.

    Raises:
        InputError: another shape.
    """
    check_shape("rotation", rotation, (3, 3))
    middle = obj.verts.mean(0)
    shift = obj.scale * (obj.rotations @ (middle - rotation @ middle))
    return replace(obj, rotations=obj.rotations @ rotation, centers=obj.centers + shift)


def _bending_axes(hand: HandPlayback, finger: str) -> list[Tensor]:
    """The axis [3] about which each joint of a finger turns its bone towards the palm, rest pose.

    The canonical hand's palm looks along -y, so the axis lies across the bone and in the palm's plane.
    """
    first, second, third = (hand.rest_joints[joint + 1] for joint in FINGERS[finger])
    bones = (second - first, third - second, third - second)
    palm = first.new_tensor([0.0, -1.0, 0.0])
    return [torch.nn.functional.normalize(torch.linalg.cross(bone, palm), dim=-1) for bone in bones]

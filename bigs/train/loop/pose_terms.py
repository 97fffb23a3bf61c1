"""Loss terms of poses, shape and light: outlines, contact, and what is plausible over time."""

from __future__ import annotations

import torch
from torch import Tensor

from bigs.losses.contact import center_contact, fingers_on_surface, penetration, surface_contact
from bigs.losses.regularizers import squared_norm
from bigs.losses.temporal import acceleration, pose_steps, velocity
from bigs.losses.weighted import mean_of
from bigs.train.loop.step import Step
from bigs.types import Side


def silhouette(step: Step) -> Tensor:
    """Every hand alone against its own mask, by what its mesh covers."""
    return mean_of(step.silhouette(side) for side in step.scene.sides if len(step.frames_of(side)))


def smooth(step: Step) -> Tensor:
    """The paper's L_smt (Eq. 6): squared steps of fingers and wrist from frame to frame."""

    def one(side: Side) -> Tensor:
        pose = step.posed_clip.canonical_hand(side)
        return pose_steps(pose.hand_pose, pose.wrist)

    return mean_of(one(side) for side in step.scene.sides)


def joint_acceleration(step: Step) -> Tensor:
    """Second differences over time of the joints of all hands, which have as many each."""
    return acceleration(torch.cat(list(step.joints.values()), dim=1)) if step.joints else torch.zeros(())


def object_acceleration(step: Step) -> Tensor:
    """Second differences over time of three points at the object's reach along its axes."""
    if not step.has_object:
        return torch.zeros(())
    reach = step.scene.object_surface.verts.abs().amax()
    corners = reach * torch.eye(3)
    return acceleration(step.posed_clip.object_points(corners))


def orient_prior(step: Step) -> Tensor:
    """Squared residuals of global orientation, radians."""
    return mean_of(squared_norm(poses.orient) for poses in step.scene.hand_poses.values())


def pose_prior(step: Step) -> Tensor:
    """Squared finger residuals of every frame, those of its grasp included."""
    return mean_of(
        squared_norm(poses.pose + poses.pose_bias + step.scene.grasps[side].pose_residuals())
        for side, poses in step.scene.hand_poses.items()
    )


def fingers_even(step: Step) -> Tensor:
    """How unevenly joints bend from the index to the pinky, squared radians, a mean over hands."""
    return mean_of(costs.unevenness for costs in step.finger_costs.values())


def joint_axes(step: Step) -> Tensor:
    """How far finger joints turn about axes that they do not have, squared radians, a mean over hands."""
    return mean_of(costs.impossible for costs in step.finger_costs.values())


def finger_tendons(step: Step) -> Tensor:
    """How far outermost finger joints bend otherwise than their tendons tell, a mean over hands."""
    return mean_of(costs.uncoupled for costs in step.finger_costs.values())


def depth_prior(step: Step) -> Tensor:
    """Squared relative distance from the depth that a frame outside grasps is expected to have."""

    def one(side: Side) -> Tensor:
        poses = step.scene.hand_poses[side]
        away = step.posed_clip.hand(side).wrist[:, 2].log() - poses.expected_log_depth
        return (poses.has_expected_depth * away.square()).mean()

    return mean_of(one(side) for side in step.scene.sides)


def betas_prior(step: Step) -> Tensor:
    """Squared change of shape from the start, in the units of betas."""
    return mean_of(
        squared_norm(step.scene.betas[side] - step.scene.base_betas[side]) for side in step.scene.betas
    )


def object_prior(step: Step) -> Tensor:
    """Squared departure of the object's poses from their start, counted by how well each frame is known."""
    return squared_norm(step.scene.object_poses.departures()) if step.has_object else torch.zeros(())


def shade_prior(step: Step) -> Tensor:
    """Squared shade of every frame: what one light for the clip explains is not for shade to explain."""
    lighting = step.scene.lighting
    return mean_of([] if lighting is None else (squared_norm(shade) for shade in lighting.shade.values()))


def rigid(step: Step) -> Tensor:
    """A hand that holds the object moves with it: its joints stay where they are in the object's frame."""
    if not step.has_object:
        return torch.zeros(())

    def one(side: Side) -> Tensor:
        touching = step.evidence.touching[side]
        joints = step.posed_clip.in_object_frame(step.joints[side])
        return velocity(joints, touching[1:] * touching[:-1])

    return mean_of(one(side) for side in step.scene.sides)


def contact(step: Step) -> Tensor:
    """Eq. 8, or its surface form; a mean over the hands."""
    if not step.has_object:
        return torch.zeros(())
    if step.evidence.contact == "center":
        centers = step.posed_clip.object.centers
        return mean_of(
            center_contact(centers, joints[:, 0], step.evidence.touching[side])
            for side, joints in step.joints.items()
        )
    return mean_of(
        surface_contact(touch.depths[:, 0], step.evidence.touching[side][step.touch_frames])
        for side, touch in step.touches.items()
    )


def finger_contact(step: Step) -> Tensor:
    """Fingers that hold the object touch it, whether a picture shows them or not; a mean over holding hands.

    Not thumbs: they often stand off.
    """
    if not step.has_object:
        return torch.zeros(())
    grasps = step.scene.grasps
    # Hands that hold nothing say 0.
    each = [
        fingers_on_surface(touch.depths[:, 1:], grasps[side].certainty[step.touch_frames])
        for side, touch in step.touches.items()
    ]
    holding = sum(bool(grasps[side].count) for side in step.touches)
    return mean_of(each) * (len(each) / max(holding, 1))


def penetrating(step: Step) -> Tensor:
    """Squared depth of hand vertices inside the object, in centimetres beyond a millimetre."""
    if not step.has_object:
        return torch.zeros(())
    return mean_of(penetration(touch.sunk) for touch in step.touches.values())

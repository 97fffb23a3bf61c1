"""Trainable groups by name, and the optimiser over those that a stage lists."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Literal

from torch import nn

from bigs.checks import InputError, expected_among
from bigs.models.poses import HandPoses, ObjectPoses
from bigs.models.scene import Scene
from bigs.train.loop.adam import FrameAdam

_LIGHT = {"light": "clip", "shade": "shade", "ambient": "ambient"}
# Group name -> its parameters, below a hand's or the object's modules.
_HAND_FIELD = ("triplane", "appearance", "geometry", "skinning", "color")
_HAND_POSE = ("betas", "orient", "pose", "pose_bias", "ray", "depth")
# Poses of a whole grasp, relative to the object.
_GRASP = {"grasp_orient": "orient", "grasp_pose": "pose", "grasp_position": "position"}
# Gaussians without a field.
_DETAIL = ("shift", "size", "opacity", "color")
_OBJECT_FIELD = ("triplane", "appearance", "geometry")
GROUPS = (
    *(f"hand.{name}" for name in (*_HAND_FIELD, *_DETAIL[:-1], *_HAND_POSE, *_GRASP)),
    *(f"object.{name}" for name in (*_OBJECT_FIELD, *_DETAIL, "orient", "ray", "depth", "scale")),
    "scene.light",
    "scene.shade",
    "scene.ambient",
)
# Parameters with one row per frame. A step that does not look at a frame says nothing about its rotations and
# fingers; rays and depths gain from momentum and from smoothness in time.
_ROW_PER_FRAME = ("hand.orient", "hand.pose", "object.orient")
FIELD_GROUPS = {
    "hand": tuple(f"hand.{name}" for name in (*_HAND_FIELD, *_DETAIL[:-1])),
    "object": tuple(f"object.{name}" for name in (*_OBJECT_FIELD, *_DETAIL)),
}
# What only a subject with a field has, and what only one without has: the hand's colour is in both.
ONLY_IN_FIELDS = {
    "hand": {f"hand.{name}" for name in _HAND_FIELD[:-1]},
    "object": {f"object.{name}" for name in _OBJECT_FIELD},
}
ONLY_FREE = {
    "hand": {f"hand.{name}" for name in _DETAIL[:-1]},
    "object": {f"object.{name}" for name in _DETAIL},
}


def group_parameters(scene: Scene, group: str) -> list[nn.Parameter]:
    """The parameters of a group; empty when the clip lacks the subject.

    Raises:
        InputError: there is no such group.
    """
    if group not in GROUPS:
        raise InputError(f"stage lrs: {expected_among(group, GROUPS, 'groups')}")
    subject, name = group.split(".")
    if subject == "scene":
        owners = [] if scene.lighting is None else [getattr(scene.lighting, _LIGHT[name])]
    elif subject == "hand":
        if name in (*_HAND_FIELD, *_DETAIL):
            owners = _present(scene.hand_splats.values(), name)
        elif name == "betas":
            owners = list(scene.betas.values())
        elif name in _GRASP:
            owners = [getattr(grasps, _GRASP[name]) for grasps in scene.grasps.values()]
        else:
            owners = [_pose_parameter(poses, name) for poses in scene.hand_poses.values()]
    elif scene.object_splats is None or scene.object_poses is None:
        owners = []
    elif name in (*_OBJECT_FIELD, *_DETAIL):
        owners = _present([scene.object_splats], name)
    else:
        owners = [
            scene.object_poses.log_scale if name == "scale" else _pose_parameter(scene.object_poses, name)
        ]
    return [p for owner in owners for p in _parameters(owner)]


def _present(splats: Iterable[nn.Module], name: str) -> list[nn.Module | nn.Parameter]:
    """A subject has a field until its Gaussians are freed of it, and parameters of their own from then on."""
    return [getattr(one, name) for one in splats if hasattr(one, name)]


def _pose_parameter(poses: HandPoses | ObjectPoses, name: str) -> nn.Parameter:
    if name in ("ray", "depth"):
        return poses.position.ray if name == "ray" else poses.position.log_depth
    parameter: nn.Parameter = getattr(poses, name)
    return parameter


def _parameters(owner: nn.Module | nn.Parameter) -> Iterable[nn.Parameter]:
    return [owner] if isinstance(owner, nn.Parameter) else owner.parameters()


def make_optimizer(
    scene: Scene,
    lrs: Mapping[str, float],
    betas: tuple[float, float],
    frame_moments: bool = False,
) -> FrameAdam:
    """Adam over the listed groups; everything else is set not to require a gradient.

    `betas` and `frame_moments` are as in `OptimizeStage`. Without a grasp the object's size stays as it is:
    no picture tells it then, and Adam would follow rounding.
    """
    scene.requires_grad_(False)
    held = any(grasps.count for grasps in scene.grasps.values())
    groups = []
    for name, lr in lrs.items():
        if name == "object.scale" and not held:
            continue
        parameters = group_parameters(scene, name)
        for parameter in parameters:
            parameter.requires_grad_(True)
        if parameters:
            per_frame = frame_moments and name in _ROW_PER_FRAME
            groups.append(
                {"params": parameters, "lr": lr, "start_lr": lr, "name": name, "per_frame": per_frame}
            )
    return FrameAdam(groups, betas, eps=1e-15)


def set_rates(
    optimizer: FrameAdam,
    progress: float,
    final: float,
    caution: float = 1.0,
    decay: Literal["cosine", "exponential"] = "cosine",
) -> None:
    """Set every group's rate for `progress` in [0, 1]: `caution` times its start, down to `final` of that."""
    if decay == "cosine":
        fallen = final + (1.0 - final) * 0.5 * (1.0 + math.cos(math.pi * progress))
    else:
        fallen = final**progress
    for group in optimizer.param_groups:
        group["lr"] = group["start_lr"] * caution * fallen

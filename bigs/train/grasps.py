"""Finding grasps: over which frames does a hand stand still in the object's frame?"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from bigs.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from bigs.hand import mirror_rotation
from bigs.models.scene import Scene
from bigs.train.config import GraspStage
from bigs.types import Side


def still_frames(joints: Tensor, touching: Tensor, stage: GraspStage) -> list[range]:
    """The stretches over which a touching hand keeps its place.

    A hand that lets go and grasps again moves centimetres a frame; an estimate of a still one wavers by
    millimetres. A step or two between two stretches is bridged if the hand is where it was.

    Args:
        joints: [T, 21, 3] in the object's frame, metres.
        touching: [T] 1 where hand and object touch in the image.
        stage: the thresholds.

    Returns:
        Stretches of at least `stage.least` frames, in order, disjoint.
    """
    speed = (joints[1:] - joints[:-1]).norm(dim=-1).mean(-1)
    together = (touching[1:] > 0) & (touching[:-1] > 0)
    still = (speed < stage.speed) & together
    stretches = []
    start = None
    for t in range(len(joints)):
        goes_on = t < len(still) and bool(still[t])
        if start is None and goes_on:
            start = t
        elif start is not None and not goes_on:
            stretches.append(range(start, t + 1))
            start = None
    bridged: list[range] = []
    for stretch in stretches:
        if bridged and stretch.start - bridged[-1].stop < stage.bridge:
            before, after = joints[bridged[-1]][-3:].mean(0), joints[stretch][:3].mean(0)
            if (after - before).norm(dim=-1).mean() < 3.0 * stage.speed:
                bridged[-1] = range(bridged[-1].start, stretch.stop)
                continue
        bridged.append(stretch)
    return [stretch for stretch in bridged if len(stretch) >= stage.least]


@torch.no_grad()
def find_grasps(scene: Scene, stage: GraspStage, touching: dict[Side, Tensor]) -> dict[Side, list[range]]:
    """Find the grasps of every hand in the scene as it is, and let the object carry the hand through them.

    All poses become start values: residuals are zero afterwards. Fingers of free frames start from their
    estimates, corrected as those of the nearest grasps had to be, and their depths are known better than an
    outline tells them (see `expected_depths`).
    """
    frames = torch.arange(scene.n_frames)
    found = {}
    for side in scene.sides:
        joints = scene.at(frames).in_object_frame(scene.at(frames).joints(side))
        found[side] = still_frames(scene.object_poses.log_scale.exp() * joints, touching[side], stage)
        of_frame = torch.full((scene.n_frames,), -1)
        for g, stretch in enumerate(found[side]):
            of_frame[stretch.start : stretch.stop] = g
        poses, own = scene.at(frames).hand(side), scene.hand_poses[side]
        scene.grasps[side].set(of_frame, stage.slack, poses, scene.at(frames).object)
        held = scene.grasps[side].held(frames)
        own.has_expected_depth.copy_(~held & held.any())
        if held.any():
            log_depth = poses.wrist[:, 2].log()
            own.expected_log_depth.copy_(expected_depths(log_depth, own.estimated_log_depth, held))
            correction = matrix_to_axis_angle(own.estimated_pose.transpose(-1, -2) @ poses.hand_pose)
            corrected = own.estimated_pose @ axis_angle_to_matrix(carried_errors(correction, held))
            poses = poses._replace(
                hand_pose=torch.where(held[:, None, None, None], poses.hand_pose, corrected)
            )
        own.restart(poses)
        orient = scene.at(frames).hand(side).global_orient
        seen = scene.at(frames).object.rotations
        turned = turned_between(
            orient, mirror_rotation(seen) if side == "left" else seen, found[side], stage.longest_move
        )
        own.base_orient.copy_(turned)
    return found


def turned_between(orient: Tensor, carrier: Tensor, grasps: list[range], longest: int) -> Tensor:
    """Orientations in which a hand turns evenly from one grasp to the next, as seen from the object.

    From the last frame of a grasp to the first of the next the turn follows the minimum-jerk profile of human
    reaching (Flash and Hogan 1985). Silhouettes tell a turned hand badly; what it came from and what it turns
    into are known well.

    Args:
        orient: [T, 3, 3] the hand's orientation.
        carrier: [T, 3, 3] the object's.
        grasps: as `still_frames` returns them.
        longest: moves that take more frames than this are left as they are.

    Returns:
        [T, 3, 3] with the frames between grasps replaced.
    """
    orient = orient.clone()
    for before, after in pairwise(grasps):
        first, last = before[-1], after[0]
        if last - first - 1 > longest:
            continue
        there = carrier[last].T @ orient[last]
        here = carrier[first].T @ orient[first]
        turn = matrix_to_axis_angle(here.T @ there)
        between = torch.arange(first + 1, last)
        u = (between - first) / (last - first)
        share = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        orient[between] = carrier[between] @ here @ axis_angle_to_matrix(share[:, None] * turn)
    return orient


def expected_depths(log_depth: Tensor, estimated: Tensor, held: Tensor) -> Tensor:
    """Logarithmic depths [T] that frames outside grasps are expected to have.

    An outline says little of the depth of a hand that the image cuts off. Two guesses with unrelated errors
    say more together: the way from one grasp straight to the next, and the estimate less the errors that
    grasps have shown it to have.

    Args:
        log_depth: [T] as found; only those of grasps are read.
        estimated: [T] before any image was looked at.
        held: [T] bool, which frames are in grasps; at least one.
    """
    times = np.arange(len(held))
    known = held.numpy()
    between = torch.from_numpy(np.interp(times, times[known], log_depth.numpy()[known])).to(log_depth)
    carried = estimated + carried_errors(log_depth - estimated, held)
    return 0.5 * (between + carried)


def carried_errors(errors: Tensor, known: Tensor, width: float = 10.0, noise: float = 1.0) -> Tensor:
    """What errors in some frames say about the others: Gaussian-process regression over time.

    Estimators err alike in frames near each other, and to a part in all frames of a clip: the covariance of
    two frames is a constant plus a bell of `width` frames, of equal weight.

    Args:
        errors: [T, ...] in any unit; only those of `known` frames are read.
        known: [T] bool, at least one.
        width: of the bell, in frames.
        noise: standard deviation of a known error relative to that of either part.

    Returns:
        [T, ...] expected errors.
    """
    times = torch.arange(len(errors), dtype=errors.dtype)
    seen = times[known]

    def covariance(a: Tensor, b: Tensor) -> Tensor:
        return 1.0 + torch.exp(-0.5 * ((a[:, None] - b) / width) ** 2)

    gram = covariance(seen, seen) + noise**2 * torch.eye(len(seen), dtype=errors.dtype)
    weights = torch.linalg.solve(gram, errors[known].reshape(len(seen), -1))
    return (covariance(times, seen) @ weights).reshape(errors.shape)

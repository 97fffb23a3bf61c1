"""Grasps of a scene, found from estimates and pictures, and start values of the frames between them."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from bigs.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from bigs.hand import mirror_rotation
from bigs.models.grasps import Grasps
from bigs.models.poses import HandFrames, HandPoses, ObjectFrames
from bigs.models.scene import Scene
from bigs.train.grasps.search import (
    Prices,
    Stretch,
    certainties,
    frame_errors,
    grasps_by_estimates,
    grasps_by_frames,
    joined,
)
from bigs.train.plan.config import GraspStage
from bigs.types import Side

# The joints that give a hand's position: the wrist, the knuckles and the fingertips.
_JOINTS = (0, 1, 4, 7, 10, 13, 16, 17, 18, 19, 20)
# However wrong its depth is, a hand that holds the object is within this distance of its surface, metres.
_ARM = 0.3
# An object at rest would move a hand that it carries by no more than this, in metres, within a quarter of a
# second: tracks err by less, and nobody holds as still.
_AT_REST = 0.003
# Pictures say more than estimates, so in the second cut half of a frame's price comes from the masks.
_ESTIMATE_SHARE = 0.5

# Errors of orientations between grasps, radians: as found; of an even turn at its ends; and what is added
# half way, as a share of the turn.
_FOUND_ERROR, _EVEN_ERROR, _WAY_ERROR = math.radians(8.0), math.radians(2.0), 0.1
# What is found wavers from frame to frame, a hand does not: a standard deviation of so many frames takes that
# out.
_JITTER = 1.0

# How badly a hand's outline in poses of some frames [B], which may repeat, disagrees with its masks: [B]
# squared error per pixel of the hand, NaN in frames whose masks say nothing.
Mismatch = Callable[[Side, HandFrames, Tensor], Tensor]


class FoundGrasps(NamedTuple):
    """The grasps of one hand."""

    stretches: list[range]  # in order, disjoint
    certainty: Tensor  # [T] in [0, 1]; 0 outside grasps

    def text(self) -> str:
        """In words, with the mean certainty of each."""
        parts = [
            f"{s.start}-{s.stop - 1} ({float(self.certainty[s.start : s.stop].mean()):.0%})"
            for s in self.stretches
        ]
        return ", ".join(parts) or "(none)"


@torch.no_grad()
def find_grasps(
    scene: Scene, stage: GraspStage, touching: dict[Side, Tensor], mismatch: Mismatch | None = None
) -> dict[Side, FoundGrasps]:
    """Find the grasps of every hand in the scene as it is, and let the object carry the hand through them.

    The estimates propose grasps. Each is then carried with the object to all frames, and what the masks say
    there decides which frames it has: grasps grow, shrink, replace one another, or vanish. Where the object
    hardly moves, a hand that rests beside it shows the same as one that holds it, and counts as free.

    All poses become start values: residuals are zero afterwards. Fingers of free frames start from their
    estimates, corrected as those of the nearest grasps had to be, and their depths are known better than an
    outline tells them (see `expected_depths`). Their orientations are those of `turned_between`.

    Args:
        scene: changed in place.
        stage: the prices.
        touching: for each hand [T] 1 where its mask and the object's meet.
        mismatch: asks the pictures; without it the estimates alone decide.
    """
    frames = torch.arange(scene.n_frames)
    found = {}
    for side in scene.sides:
        at = scene.at(frames)
        poses, carrier, own = at.hand(side), at.object, scene.hand_poses[side]
        found[side] = _search(scene, side, stage, touching[side] > 0, mismatch)
        of_frame = torch.full((scene.n_frames,), -1)
        for g, stretch in enumerate(found[side].stretches):
            of_frame[stretch.start : stretch.stop] = g
        scene.grasps[side].set(of_frame, stage.slack, poses, carrier, found[side].certainty)
        grasped = scene.grasps[side].covers(frames)
        own.has_expected_depth.copy_(~grasped & grasped.any())
        if grasped.any():
            log_depth = poses.wrist[:, 2].log()
            own.expected_log_depth.copy_(
                expected_depths(log_depth, own.estimated_log_depth, grasped, stage.alike)
            )
            correction = matrix_to_axis_angle(own.estimated_pose.transpose(-1, -2) @ poses.hand_pose)
            carried = carried_errors(correction, grasped, stage.alike)
            corrected = own.estimated_pose @ axis_angle_to_matrix(carried)
            poses = poses._replace(
                hand_pose=torch.where(grasped[:, None, None, None], poses.hand_pose, corrected)
            )
        own.restart(poses)
        orient = scene.at(frames).hand(side).global_orient
        seen = scene.at(frames).object.rotations
        turned = turned_between(
            orient,
            mirror_rotation(seen) if side == "left" else seen,
            found[side].stretches,
            stage.longest_move,
        )
        own.base_orient.copy_(turned)
    return found


def _search(
    scene: Scene, side: Side, stage: GraspStage, touching: Tensor, mismatch: Mismatch | None
) -> FoundGrasps:
    at = scene.at(torch.arange(scene.n_frames))
    poses, carrier = at.hand(side), at.object
    joints = at.joints(side)[:, list(_JOINTS)]
    points, information = _in_frame_of(carrier, joints, stage)
    world, at_rest = _resting(carrier), _at_rest(carrier, joints, 2 * stage.least)
    touches = touching.numpy()
    reach = float(carrier.scale * scene.object_surface.verts.norm(dim=1).max()) + _ARM

    def reached(stretches: list[range]) -> list[range]:
        """Those in which the hand is near the object; its outline may meet the object's metres away."""
        places = [_place(points[s], information[s]) for s in stretches]
        return [
            s
            for s, place in zip(stretches, places, strict=True)
            if np.linalg.norm(place, axis=1).min() < reach
        ]

    prices = Prices(stage.free, stage.grasp, stage.least, stage.gap)
    proposed = reached(grasps_by_estimates(points, information, touches, prices))
    stretches = [Stretch(frames, h) for h, frames in enumerate(proposed)]
    costs = _estimate_costs(points, information, proposed)
    if mismatch is not None:
        # The usual disagreement of a hand in its own pose; frames with wrong estimates have more.
        usual = float(mismatch(side, poses, torch.arange(scene.n_frames)).nanquantile(0.25))
        apart = prices.free * ~touches

        def judged(frame: ObjectFrames, hypotheses: list[range]) -> tuple[np.ndarray, np.ndarray]:
            """What each frame pays for a hand that `frame` carries, by pictures and in all: [H, T]."""
            pictures = [_excess(mismatch, side, poses, frame, h, usual) for h in hypotheses]
            by_estimate = _estimate_costs(*_in_frame_of(frame, joints, stage), hypotheses)
            by_picture = prices.free / stage.excess * np.reshape(pictures, by_estimate.shape)
            return by_picture, by_picture + _ESTIMATE_SHARE * np.minimum(by_estimate, prices.free)

        for _ in range(stage.rounds):
            hypotheses = reached(_hypotheses([s.frames for s in stretches], scene.n_frames, prices))
            pictures, costs = judged(carrier, hypotheses)
            pictures, costs = np.maximum(pictures, apart), np.maximum(costs, apart)
            _, resting = judged(world, _parts(hypotheses, at_rest, prices.least_at_border))
            again = joined(grasps_by_frames(costs, prices, resting), pictures, prices)
            settled = [s.frames for s in again] == [s.frames for s in stretches]
            stretches = again
            if settled:
                break
    sure = np.zeros(scene.n_frames)
    for frames, hypothesis in stretches:
        sure[frames] = certainties(costs[hypothesis, frames], prices.free)
    return FoundGrasps([s.frames for s in stretches], torch.as_tensor(sure, dtype=torch.float32))


def _hypotheses(stretches: list[range], count: int, prices: Prices) -> list[range]:
    """The frames that give hypotheses: each grasp, two neighbours as one, and frames outside grasps."""
    least, few = prices.least, min(prices.least_at_border, count)
    found = list(stretches)
    found += [range(a.start, b.stop) for a, b in pairwise(stretches)]
    edges = [0, *(edge for s in stretches for edge in (s.start, s.stop)), count]
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        # Windows that overlap by half, so that most of a grasp lies in one of them.
        step = 2 * least
        found += [range(a, min(a + step, stop)) for a in range(start, stop - least + 1, least)]
    # What the clip's border cuts off may be short.
    return [*found, range(few), range(count - few, count)]


def _estimate_costs(points: np.ndarray, information: np.ndarray, stretches: list[range]) -> np.ndarray:
    """[H, T] squared errors of the estimates in every frame, for the mean hand of each stretch."""
    rows = [frame_errors(points, information, _place(points[s], information[s])) for s in stretches]
    return np.stack(rows) if rows else np.zeros((0, len(points)))


def _place(points: np.ndarray, information: np.ndarray) -> np.ndarray:
    """The still hand [K, 3] that explains some frames best, robustly."""
    place = np.median(points, axis=0)
    for _ in range(3):
        trust = 1.0 / (1.0 + frame_errors(points, information, place))
        weighted = trust[:, None, None] * information
        place = np.linalg.solve(weighted.sum(0), np.einsum("tij,tkj->ik", weighted, points)).T
    return place


def _excess(
    mismatch: Mismatch, side: Side, poses: HandFrames, carrier: ObjectFrames, frames: range, usual: float
) -> np.ndarray:
    """How much worse than `usual` a hand that the object carries through all T frames fits its masks."""
    count = len(carrier.centers)
    grasp = Grasps(count, mirrored=side == "left")
    of_frame = torch.full((count,), -1)
    of_frame[frames.start : frames.stop] = 0
    grasp.set(of_frame, 0.0, poses, carrier)
    grasp.of_frame.zero_()
    every = torch.arange(count)
    carried = mismatch(side, HandPoses(*poses)(every, grasp(carrier)), every)
    return torch.nan_to_num(carried - usual, nan=0.0).double().numpy()


def _resting(carrier: ObjectFrames) -> ObjectFrames:
    """Poses of an object that does not move."""
    return carrier._replace(
        rotations=torch.eye(3).expand_as(carrier.rotations), centers=torch.zeros_like(carrier.centers)
    )


def _at_rest(carrier: ObjectFrames, joints: Tensor, least: int) -> np.ndarray:
    """Frames [T] (bool) among so many, `least` or more, in which the object hardly moves what it carries.

    None if it never does: of an object that nobody moves, touch alone tells who holds it.

    Args:
        carrier: the object.
        joints: [T, K, 3] of a hand.
        least: fewer frames do not tell.
    """
    still = np.zeros(len(joints), dtype=bool)
    for start in range(max(len(joints) - least, 0) + 1):
        window = slice(start, start + least)
        middle = min(start + least // 2, len(joints) - 1)
        held = (joints[middle] - carrier.centers[middle]) @ carrier.rotations[middle]
        carried = held @ carrier.rotations[window].transpose(-1, -2) + carrier.centers[window, None]
        still[window] |= bool((carried - joints[middle]).norm(dim=-1).mean(-1).max() < _AT_REST)
    return still & ~still.all()


def _parts(stretches: list[range], chosen: np.ndarray, least: int) -> list[range]:
    """The different runs of `least` or more chosen frames (of [T] bool) within stretches."""
    found: dict[range, None] = {}
    for stretch in stretches:
        edges = np.flatnonzero(np.diff(chosen[stretch.start : stretch.stop], prepend=False, append=False))
        for start, stop in (edges.reshape(-1, 2) + stretch.start).tolist():
            if stop - start >= least:
                found[range(start, stop)] = None
    return list(found)


def _in_frame_of(carrier: ObjectFrames, joints: Tensor, stage: GraspStage) -> tuple[np.ndarray, np.ndarray]:
    """Joints [T, K, 3], the wrist first, as the carrier sees them, metres, and the information [T, 3, 3]."""
    points = (joints - carrier.centers[:, None]) @ carrier.rotations
    wrist = joints[:, 0].double()
    ray = torch.nn.functional.normalize(wrist, dim=-1)
    ray = (carrier.rotations.double().transpose(-1, -2) @ ray[..., None])[..., 0]
    along = ray[:, :, None] * ray[:, None, :]
    aside = torch.eye(3, dtype=torch.float64) - along
    depth = wrist.norm(dim=-1)[:, None, None]
    information = aside / (stage.error_aside * depth) ** 2 + along / (stage.error_along * depth) ** 2
    return points.double().numpy(), information.numpy()


def turned_between(orient: Tensor, carrier: Tensor, grasps: list[range], longest: int) -> Tensor:
    """Orientations between grasps, of two guesses with unrelated errors: as found, and an even turn.

    From the last frame of a grasp to the first of the next a hand turns about evenly as seen from the object,
    after the minimum-jerk profile of human reaching (Flash and Hogan 1985). Silhouettes tell a turned hand
    badly; what it came from and what it turns into are known well. The further it turns, and the further from
    both ends, the less is known of its way. It may turn by more than half a circle, so of the two ways it
    takes the one that the orientations found speak for.

    Args:
        orient: [T, 3, 3] the hand's orientation as found.
        carrier: [T, 3, 3] the object's.
        grasps: stretches of frames, in order and disjoint.
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
        found = orient[between]
        u = (between - first) / (last - first)
        share = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        other = turn - 2.0 * torch.pi * torch.nn.functional.normalize(turn, dim=0)
        ways = [carrier[between] @ here @ axis_angle_to_matrix(share[:, None] * way) for way in (turn, other)]
        even = min(ways, key=lambda way: float((way - found).square().sum()))
        error = _EVEN_ERROR + _WAY_ERROR * turn.norm() * 4.0 * u * (1.0 - u)
        weight = error**2 / (_FOUND_ERROR**2 + error**2)
        apart = matrix_to_axis_angle(even.transpose(-1, -2) @ found)
        apart = torch.from_numpy(gaussian_filter1d(apart.numpy(), _JITTER, axis=0, mode="nearest"))
        orient[between] = even @ axis_angle_to_matrix(weight[:, None] * apart)
    return orient


def expected_depths(log_depth: Tensor, estimated: Tensor, grasped: Tensor, alike: float) -> Tensor:
    """Logarithmic depths [T] that frames outside grasps are expected to have.

    An outline says little of the depth of a hand that the image cuts off. Two guesses with unrelated errors
    say more together: the way from one grasp straight to the next, and the estimate less the errors that
    grasps have shown it to have. Before the first grasp and after the last one the straight way leads
    nowhere. It errs twice as much there as the estimate, so it counts a quarter.

    Args:
        log_depth: [T] as found; only those of grasps are read.
        estimated: [T] before any image was looked at.
        grasped: [T] bool, which frames are in grasps; at least one.
        alike: see `carried_errors`.
    """
    times = np.arange(len(grasped))
    known = grasped.numpy()
    between = torch.from_numpy(np.interp(times, times[known], log_depth.numpy()[known])).to(log_depth)
    carried = estimated + carried_errors(log_depth - estimated, grasped, alike)
    first, last = times[known][[0, -1]]
    share = torch.from_numpy(np.where((times < first) | (times > last), 0.25, 0.5)).to(log_depth)
    return share * between + (1.0 - share) * carried


def carried_errors(errors: Tensor, known: Tensor, alike: float, noise: float = 1.0) -> Tensor:
    """Errors of other frames predicted from known ones by Gaussian-process regression over time.

    Estimators err alike in frames near each other, and to a part in all frames of a clip: the covariance of
    two frames is a constant plus a bell of `alike` frames, of equal weight.

    Args:
        errors: [T, ...] in any unit; only those of `known` frames are read.
        known: [T] bool, at least one.
        alike: width of the bell, in frames.
        noise: standard deviation of a known error relative to that of either part.

    Returns:
        [T, ...] expected errors.
    """
    times = torch.arange(len(errors), dtype=errors.dtype)
    seen = times[known]

    def covariance(a: Tensor, b: Tensor) -> Tensor:
        return 1.0 + torch.exp(-0.5 * ((a[:, None] - b) / alike) ** 2)

    gram = covariance(seen, seen) + noise**2 * torch.eye(len(seen), dtype=errors.dtype)
    weights = torch.linalg.solve(gram, errors[known].reshape(len(seen), -1))
    return (covariance(times, seen) @ weights).reshape(errors.shape)

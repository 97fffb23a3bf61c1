"""Hands from 21 2-D keypoints of each frame: pose, one shared shape, and place, by robust reprojection.

Both hands are fitted as right hands at once; the left one is seen in a mirror. Keypoints enter as rays
(x / z, y / z), so that the camera is used as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.preprocess.hands.descent import minimise
from bigs.preprocess.hands.guess import guess_poses, likeliest_sequence
from bigs.preprocess.hands.skeleton import HandPoses, HandSkeleton


@dataclass(frozen=True)
class HandFitConfig:
    """How keypoints become poses. Lengths in metres, angles in radians, times in frames at 30 a second."""

    # Error of keypoints as a share of the hand's size in the image (3 pixels for a hand of 120).
    noise: float = 0.025
    # Scale of the Geman-McClure function, in standard deviations of that noise.
    outlier: float = 3.0
    candidates: int = 6
    candidate_steps: int = 50
    exchanges: int = 3
    steps: int = 300
    rate: float = 0.03
    # Typical second differences over time of joints (of a hand of mean size) and of finger angles.
    joint_acceleration: float = 0.003
    angle_acceleration: float = 0.08
    # Pose errors are alike in all frames, so many frames say little more about the shape than few: the pull
    # to the mean shape counts this many times.
    shape_weight: float = 10.0
    # Typical motion of joints between frames, which selects among candidates.
    reach: float = 0.008
    # A frame with fewer keypoints, or fewer explained ones, is marked as having no estimate.
    joints_needed: int = 8
    # Relative error of depth between frames and between the hands; an error of the shared size is no error
    # between hands and object.
    depth_sigma: float = 0.01


class HandFit(NamedTuple):
    """H hands over T frames as right hands (a left one mirrored), in the camera frame."""

    poses: HandPoses  # leading axes [H, T]
    betas: Tensor  # [10]
    explained: Tensor  # [H, T] number of joints near their keypoints


def fit_rays(
    skeleton: HandSkeleton, rays: Tensor, trust: Tensor, config: HandFitConfig, fps: float = 30.0
) -> HandFit:
    """Fit hands to keypoints.

    Args:
        skeleton: of the right hand.
        rays: [H, T, 21, 2] keypoints over z = 1; anything finite where trust is 0.
        trust: [H, T, 21] in [0, 1]; every hand has a frame with `joints_needed` joints.
        config: weights and numbers of steps.
        fps: frames a second, which says how much may change from one to the next.
    """
    shown = (trust > 0).sum(-1) >= config.joints_needed  # [H, T]
    sigma = config.noise * _hand_sizes(rays, trust, shown)  # [H]
    pace = 30.0 / fps
    starts = [_start(skeleton, *hand, config, pace) for hand in zip(rays, trust, shown, sigma, strict=True)]
    start = HandPoses(*(torch.stack(part) for part in zip(*starts, strict=True)))
    return _refine(skeleton, start, rays, trust, sigma, config, pace)


def _hand_sizes(rays: Tensor, trust: Tensor, shown: Tensor) -> Tensor:
    """The median over frames of the largest extent of each hand's keypoints [H]."""
    sizes = []
    for hand, weight, frames in zip(rays, trust, shown, strict=True):
        seen = weight[frames][..., None] > 0
        high = hand[frames].masked_fill(~seen, -torch.inf).amax(1)
        low = hand[frames].masked_fill(~seen, torch.inf).amin(1)
        sizes.append((high - low).amax(-1).median())
    return torch.stack(sizes)


def _start(
    skeleton: HandSkeleton,
    rays: Tensor,
    trust: Tensor,
    shown: Tensor,
    sigma: Tensor,
    config: HandFitConfig,
    pace: float,
) -> HandPoses:
    """One hand's pose in every frame [T, ...]; frames without keypoints take their neighbours'."""
    frames = torch.nonzero(shown)[:, 0]
    guesses = guess_poses(skeleton, rays[frames], trust[frames], config.candidates)
    poses, energy = _improve(skeleton, guesses, rays[frames], trust[frames], sigma, config)
    for _ in range(config.exchanges):
        # A frame whose own guesses are all wrong gets a right one from a neighbour.
        offered = _with_neighbours(poses, energy)
        poses, energy = _improve(skeleton, offered, rays[frames], trust[frames], sigma, config)
        poses, energy = _best_distinct(skeleton, poses, energy, config.candidates)
    joints = _joints(skeleton, poses)
    path = likeliest_sequence(joints, energy, frames, config.reach * pace)
    nearest = (torch.arange(len(rays))[:, None] - frames).abs().argmin(1)
    rows = torch.arange(len(frames))
    return HandPoses(*(part[rows, path][nearest] for part in poses))


def _joints(skeleton: HandSkeleton, poses: HandPoses) -> Tensor:
    """Joints [B, K, 21, 3] of poses [B, K, ...] of the mean shape."""
    flat = (part.flatten(0, 1) for part in poses)
    return skeleton.joints(torch.zeros(10), *flat).unflatten(0, poses.wrist.shape[:2])


def _improve(
    skeleton: HandSkeleton,
    poses: HandPoses,
    rays: Tensor,
    trust: Tensor,
    sigma: Tensor,
    config: HandFitConfig,
) -> tuple[HandPoses, Tensor]:
    """Fit every candidate [B, K, ...] to its frame alone; with the energy [B, K] that is left."""
    count = poses.wrist.shape[1]
    variables = _Variables(HandPoses(*(part.flatten(0, 1) for part in poses)))
    target, weight = (x.repeat_interleave(count, dim=0) for x in (rays, trust))
    betas = torch.zeros(10)

    def energies() -> Tensor:
        current = variables.poses()
        fit = _misfit(skeleton.joints(betas, *current), target, weight, sigma, config.outlier)
        return fit + 0.5 * skeleton.unlikeliness(current.angles)

    minimise(lambda: energies().sum(), variables.groups(config.rate), config.candidate_steps)
    with torch.no_grad():
        improved = HandPoses(*(part.unflatten(0, (-1, count)) for part in variables.poses()))
        return improved, energies().unflatten(0, (-1, count))


def _with_neighbours(poses: HandPoses, energy: Tensor) -> HandPoses:
    """Candidates [B, K, ...] and the two likeliest of the frames before and after: [B, K + 4, ...].

    A neighbour's pose is taken over with its place, which is near enough to start from.
    """
    best = energy.argsort(dim=1)[:, :2]
    rows = torch.arange(len(energy))[:, None]
    before, after = (rows + step for step in (-1, 1))
    sources = [row.clamp(0, len(energy) - 1) for row in (before, after)]
    offered = [HandPoses(*(part[row, best[row[:, 0]]] for part in poses)) for row in sources]
    return HandPoses(*(torch.cat(parts, dim=1) for parts in zip(poses, *offered, strict=True)))


def _best_distinct(
    skeleton: HandSkeleton, poses: HandPoses, energy: Tensor, count: int
) -> tuple[HandPoses, Tensor]:
    """The likeliest `count` candidates that differ from likelier ones by more than a centimetre."""
    joints = _joints(skeleton, poses)
    shape = joints - joints[:, :, :1]
    apart = (shape[:, :, None] - shape[:, None]).square().sum(-1).mean(-1).sqrt()
    rows = torch.arange(len(energy))
    left, chosen = energy.clone(), []
    for _ in range(count):
        best = left.argmin(dim=1)
        chosen.append(best)
        # Duplicates come last instead of never, since there may be only one kind.
        left = left + 1e3 * (apart[rows, best] < 0.01)
    order = torch.stack(chosen, dim=1)
    pick = lambda part: part[rows[:, None], order]  # noqa: E731
    return HandPoses(*(pick(part) for part in poses)), pick(energy)


def _refine(
    skeleton: HandSkeleton,
    start: HandPoses,
    rays: Tensor,
    trust: Tensor,
    sigma: Tensor,
    config: HandFitConfig,
    pace: float,
) -> HandFit:
    """All frames of all hands together: shape is shared, motion is smooth."""
    hands, frames = rays.shape[:2]
    variables = _Variables(HandPoses(*(part.flatten(0, 1) for part in start)))
    betas = torch.zeros(10, requires_grad=True)
    target, weight = rays.flatten(0, 1), trust.flatten(0, 1)
    spread = sigma.repeat_interleave(frames)
    by_hand = lambda x: x.reshape(hands, frames, *x.shape[1:])  # noqa: E731
    usual_size = skeleton.size(torch.zeros(10))

    def total() -> Tensor:
        poses = variables.poses()
        joints = skeleton.joints(betas, *poses)
        loss = _misfit(joints, target, weight, spread, config.outlier).sum()
        loss = loss + 0.5 * skeleton.unlikeliness(poses.angles).sum()
        loss = loss + 0.5 * config.shape_weight * betas.square().sum()
        if frames > 2:
            # In units of the hand's own size; otherwise a small hand near the camera would seem smoother.
            step = config.joint_acceleration * pace**2 * skeleton.size(betas) / usual_size
            joint = second_differences(by_hand(joints)) / step
            angle = second_differences(by_hand(poses.angles)) / (config.angle_acceleration * pace**2)
            loss = loss + _robust(joint.square().sum(-1), 4.0).sum() / 3.0
            loss = loss + _robust(angle.square().sum(-1), 4.0).sum()
        return loss

    groups = [*variables.groups(config.rate), {"params": [betas], "lr": config.rate}]
    minimise(total, groups, config.steps)
    with torch.no_grad():
        poses = variables.poses()
        joints = skeleton.joints(betas, *poses)
        error = (_project(joints) - target).norm(dim=-1)
        near = (error < config.outlier * spread[:, None]) & (weight > 0)
        return HandFit(
            HandPoses(*(by_hand(part.detach()) for part in poses)), betas.detach(), by_hand(near.sum(-1))
        )


class _Variables:
    """A batch of poses as what an optimiser may change."""

    def __init__(self, poses: HandPoses) -> None:
        self.base = poses.orient.detach()
        self.turn = torch.zeros_like(poses.wrist, requires_grad=True)
        self.angles = poses.angles.detach().clone().requires_grad_()
        depth = poses.wrist[:, 2:].detach().clamp_min(1e-3)
        self.ray = (poses.wrist[:, :2].detach() / depth).requires_grad_()
        self.log_depth = depth.log().requires_grad_()

    def groups(self, rate: float) -> list[dict[str, Any]]:
        return [
            {"params": [self.turn, self.angles], "lr": rate},
            {"params": [self.log_depth], "lr": 0.3 * rate},
            {"params": [self.ray], "lr": 0.1 * rate},
        ]

    def poses(self) -> HandPoses:
        depth = self.log_depth.exp()
        wrist = torch.cat([self.ray * depth, depth], dim=-1)
        return HandPoses(self.angles, self.base @ axis_angle_to_matrix(self.turn), wrist)


def _project(joints: Tensor) -> Tensor:
    return joints[..., :2] / joints[..., 2:].clamp_min(1e-2)


def _robust(squares: Tensor, scale: float) -> Tensor:
    """Half of Geman and McClure's function of squared residuals: quadratic when small, at most scale² / 2."""
    return 0.5 * squares / (1.0 + squares / scale**2)


def _misfit(joints: Tensor, target: Tensor, trust: Tensor, sigma: Tensor, outlier: float) -> Tensor:
    """Misfit [B] of joints [B, 21, 3] to keypoints [B, 21, 2]."""
    error = (_project(joints) - target) / sigma.reshape(-1, 1, 1)
    return (trust * _robust(error.square().sum(-1), outlier)).sum(-1)


def second_differences(values: Tensor) -> Tensor:
    """Over the second axis, [H, T, ...] to [H, T - 2, ...]."""
    return values[:, 2:] - 2.0 * values[:, 1:-1] + values[:, :-2]

"""Poses of single frames on trial: many fitted side by side to outlines, each at a price of its own."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from bigs.fused.fingers import finger_costs
from bigs.models.poses import HandFrames, HandPoses
from bigs.models.scene import Scene
from bigs.train.grasps.find import Mismatch
from bigs.train.loop.adam import FrameAdam
from bigs.train.loop.optim import set_rates
from bigs.train.loop.step import Evidence
from bigs.train.plan.config import MoveStage
from bigs.types import Side

# The groups that move, and the terms that add to a pose's price: priors on the pose alone, and what its
# neighbours say of it, which `moves.search` adds.
RATED = ("hand.orient", "hand.pose", "hand.ray", "hand.depth")
_PRIORS = ("pose_prior", "fingers_even", "joint_axes", "finger_tendons", "depth_prior")
PRICED = (*_PRIORS, "acceleration")
# Trials that are rendered together: more of them would take memory, but no less time.
_TOGETHER = 96
# Rates fall to this share.
_FINAL_RATE = 0.2
# Adam's: so few steps would hardly forget the first.
_BETAS = (0.8, 0.95)


class Tried(NamedTuple):
    """N poses, and what speaks against each."""

    poses: HandFrames  # of N
    mismatch: Tensor  # [N] with the masks; NaN where these say nothing
    price: Tensor  # [N] mismatch and implausibility together

    def at(self, places: Tensor) -> Tried:
        """Some of them [M], by their indices."""
        return Tried(poses_at(self.poses, places), self.mismatch[places], self.price[places])

    def put(self, place: int, one: Tried) -> None:
        """Put the one pose of another in the place of this one's."""
        for part, new in zip((*self.poses, *self[1:]), (*one.poses, *one[1:]), strict=True):
            part[place] = new[0]

    def copy(self) -> Tried:
        """One whose changes leave this one alone."""
        return Tried(HandFrames(*(part.clone() for part in self.poses)), *(part.clone() for part in self[1:]))


class Trials:
    """What poses of one hand are fitted to."""

    def __init__(
        self, scene: Scene, side: Side, stage: MoveStage, evidence: Evidence, mismatch: Mismatch
    ) -> None:
        self._own, self._side, self._stage = scene.hand_poses[side], side, stage
        self._turns, self._bends = evidence.impossible_turns[side], evidence.bends[side]
        self._mismatch = mismatch

    @torch.no_grad()
    def price(self, frames: Tensor, poses: HandFrames) -> Tried:
        """Poses as they are, each in its own of `frames` [N], which may repeat."""
        mismatch = self._mismatch(self._side, poses, frames)
        each = [self._implausible(frame, poses_at(poses, place)) for place, frame in _one_by_one(frames)]
        return Tried(poses, mismatch, mismatch + torch.stack(each))

    def fit(self, frames: Tensor, starts: HandFrames, steps: int) -> Tried:
        """Poses that `steps` steps reach from N starts, each in its own of `frames` [N], which may repeat."""
        batches = torch.arange(len(frames)).split(_TOGETHER)
        tried = [self._fit(frames[batch], poses_at(starts, batch), steps) for batch in batches]
        return Tried(
            poses_together([one.poses for one in tried]),
            torch.cat([one.mismatch for one in tried]),
            torch.cat([one.price for one in tried]),
        )

    def _fit(self, frames: Tensor, starts: HandFrames, steps: int) -> Tried:
        moving = HandPoses(*(part.detach() for part in starts))
        all_of_them = torch.arange(len(frames))
        moved = (moving.orient, moving.pose, moving.position.ray, moving.position.log_depth)
        parameters = dict(zip(RATED, moved, strict=True))
        # One Adam for all: every one of them moves by its own gradient alone.
        optimizer = FrameAdam(
            [
                {"params": [parameters[name]], "lr": rate, "start_lr": rate}
                for name, rate in self._stage.lrs.items()
            ],
            _BETAS,
        )
        for step in range(steps):
            poses = moving(all_of_them)
            off = self._mismatch(self._side, poses, frames).sum()
            (off + len(frames) * self._implausible(frames, poses)).backward()
            set_rates(optimizer, step / steps, _FINAL_RATE)
            optimizer.step()
            optimizer.zero_grad()
        with torch.no_grad():
            return self.price(frames, moving(all_of_them))

    def _implausible(self, frames: Tensor, poses: HandFrames) -> Tensor:
        """The stage's priors on poses, a mean over `frames`; squared angles by chords."""
        own, weights = self._own, self._stage.weights
        pose = poses.hand_pose
        away = poses.wrist[:, 2].log() - own.expected_log_depth[frames]
        values = (  # in the order of `_PRIORS`
            0.5 * (pose - own.base_pose[frames]).square().sum((-1, -2)).mean(),
            *finger_costs(pose, self._turns, self._bends),
            (own.has_expected_depth[frames] * away.square()).mean(),
        )
        priced = (weights.get(name, 0.0) * one for name, one in zip(_PRIORS, values, strict=True))
        return sum(priced, torch.zeros(()))


def poses_at(poses: HandFrames, places: Tensor) -> HandFrames:
    """Some of N poses, by their indices."""
    return HandFrames(*(part[places] for part in poses))


def poses_together(poses: Iterable[HandFrames]) -> HandFrames:
    """Poses one after another."""
    return HandFrames(*(torch.cat(parts) for parts in zip(*poses, strict=True)))


def _one_by_one(frames: Tensor) -> list[tuple[Tensor, Tensor]]:
    """The place of each frame, and the frame, as tensors of length 1."""
    return [(torch.tensor([place]), frame[None]) for place, frame in enumerate(frames)]

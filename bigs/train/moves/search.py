"""Frames between grasps that are caught in a wrong pose try those of their neighbours.

Each of them is fitted to its own picture. From a poor start that ends in a pose from which every small step
is worse: mostly a finger lies where its neighbour belongs. The outline then stays wrong, often next to a
frame in which it is right. So poses spread: a wrong frame tries its own and those of its neighbours,
as they are and turned in the palm's plane by a finger's width either way, and takes one that suits picture
and motion better. The frames beyond it may go on from there.

A grasp's first or last frames may belong to the move beside it. Where the carried hand does not suit the
picture and another one does by far, the grasp lets go of them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.hand import mirror_points
from bigs.losses.temporal import acceleration
from bigs.models.poses import HandFrames
from bigs.models.scene import Scene
from bigs.train.grasps.find import Mismatch
from bigs.train.loop.step import Evidence
from bigs.train.moves.trials import Trials, Tried, poses_at, poses_together
from bigs.train.plan.config import MoveStage
from bigs.types import Side

# MANO's base joints of index and pinky, which span the palm with the wrist.
_PALM = (1, 7)
# A neighbour is worth trying if its outline disagrees by less than this share of the frame's own.
_BETTER = 0.8
# Fewest frames that a grasp keeps.
_KEPT = 4


class Moved(NamedTuple):
    """What became of a hand's frames between grasps."""

    frames: int  # how many there are now
    renewed: int  # of these, those with another pose
    let_go: list[int]  # those that were in a grasp

    def text(self) -> str:
        """In words."""
        text = f"another pose in {self.renewed} of {self.frames} frames between grasps"
        if self.let_go:
            text += f", {len(self.let_go)} of which {'was' if len(self.let_go) == 1 else 'were'} in one"
        return text


def search_moves(scene: Scene, stage: MoveStage, evidence: Evidence, mismatch: Mismatch) -> dict[Side, Moved]:
    """Find better poses for hands between grasps, and let go of frames that belong there.

    Args:
        scene: changed in place; renewed poses become start values.
        stage: see there.
        evidence: of the stage's image size.
        mismatch: asks the pictures.
    """
    # Poses of trials alone have gradients.
    scene.requires_grad_(False)
    return {side: _Search(scene, side, stage, evidence, mismatch).run() for side in scene.sides}


class _Search:
    """The search for one hand: the poses of all T frames, and what speaks against each."""

    def __init__(
        self, scene: Scene, side: Side, stage: MoveStage, evidence: Evidence, mismatch: Mismatch
    ) -> None:
        self._scene, self._side, self._stage = scene, side, stage
        self._trials = Trials(scene, side, stage, evidence, mismatch)
        wrist, index, pinky = scene.hand_model(side).rest_joints(scene.hand_betas(side))[[0, *_PALM]]
        across = torch.linalg.cross(index - wrist, pinky - wrist)
        self._palm = across / across.norm()
        frames = torch.arange(scene.n_frames)
        self._now = self._trials.price(frames, scene.at(frames).hand(side)).copy()
        self._renewed: set[int] = set()

    def run(self) -> Moved:
        carried = self._now.copy()
        ends = self._loose_ends()
        free = self._scene.grasps[self._side].of_frame < 0
        for end in ends:
            free[end] = True
        for number in range(self._stage.rounds):
            if not self._spread(torch.nonzero(free).flatten().tolist(), first=number == 0):
                break
        let_go = [frame for end in ends for frame in self._better_alone(end, carried)]
        for end in ends:
            held = [frame for frame in end if frame not in let_go]
            free[held] = False
            self._renewed -= set(held)
        self._write(let_go, carried.poses.wrist)
        return Moved(int(free.sum()), len(self._renewed), sorted(let_go))

    def _usual(self) -> Tensor:
        """How far outlines disagree that are as right as they get."""
        return self._now.mismatch.nanmedian().clamp_min(self._stage.exact)

    def _loose_ends(self) -> list[list[int]]:
        """Frames in which a carried hand does not suit the picture, inwards from each end of each grasp."""
        of_frame, mismatch = self._scene.grasps[self._side].of_frame, self._now.mismatch
        found = []
        for grasp in range(self._scene.grasps[self._side].count):
            frames = torch.nonzero(of_frame == grasp).flatten().tolist()
            usual = max(mismatch[frames].nanmedian(), self._usual())
            for inwards in (frames, frames[::-1]):
                end: list[int] = []
                while len(end) < min(self._stage.loose_frames, len(frames) - _KEPT):
                    frame = inwards[len(end)]
                    # Nothing comes before a clip's first frame, so that no move can begin there.
                    if frame in (0, len(mismatch) - 1) or not mismatch[frame] > self._stage.loose * usual:
                        break
                    end.append(frame)
                frames = [frame for frame in frames if frame not in end]
                found.append(end)
        return found

    def _spread(self, moves: list[int], first: bool) -> bool:
        """Let wrong frames among `moves` try other poses; whether any has taken one."""
        mismatch, usual = self._now.mismatch, self._usual()
        frames: list[int] = []
        starts: list[HandFrames] = []
        for frame in moves:
            if not mismatch[frame] > self._stage.worse * usual:
                continue
            for source in (frame - 1, frame + 1):
                if 0 <= source < len(mismatch) and mismatch[source] < _BETTER * mismatch[frame]:
                    starts += self._starts(source, (0.0, 1.0, -1.0))
            if first:
                starts += self._starts(frame, (0.0, 1.0, -1.0))
            frames += [frame] * (len(starts) - len(frames))
        if not frames:
            return False
        places = torch.tensor(frames)
        rough = self._trials.fit(places, poses_together(starts), self._stage.trial_steps[0])
        best = torch.cat([_cheapest(rough.price, places == frame, self._stage.best) for frame in set(frames)])
        places = places[best]
        fine = self._trials.fit(places, rough.at(best).poses, self._stage.trial_steps[1])
        taken = [
            self._take(frame, fine.at(torch.tensor([place]))) for place, frame in enumerate(places.tolist())
        ]
        return any(taken)

    def _starts(self, source: int, turns: tuple[float, ...]) -> list[HandFrames]:
        """The pose of frame `source`, turned in the palm's plane by so many finger's widths each."""
        pose = poses_at(self._now.poses, torch.tensor([source]))
        axis = self._stage.turn * pose.global_orient @ self._palm
        return [
            pose._replace(global_orient=axis_angle_to_matrix(turn * axis) @ pose.global_orient)
            for turn in turns
        ]

    def _take(self, frame: int, tried: Tried) -> bool:
        """Give a frame the pose of a trial if it is better there; whether it was."""
        old = self._now.at(torch.tensor([frame]))
        weight = self._stage.weights.get("acceleration", 0.0)
        new_price = tried.price + weight * self._acceleration(frame, tried.poses)
        better = bool(
            new_price < self._stage.gain * (old.price + weight * self._acceleration(frame, old.poses))
        )
        if better:
            self._now.put(frame, tried)
            self._renewed.add(frame)
        return better

    def _acceleration(self, frame: int, poses: HandFrames) -> Tensor:
        """That of the joints if a frame had this pose; zero at the clip's ends."""
        if not 0 < frame < len(self._now.price) - 1:
            return torch.zeros(())
        before, after = (poses_at(self._now.poses, torch.tensor([frame + step])) for step in (-1, 1))
        three = poses_together([before, poses, after])
        wrist = mirror_points(three.wrist) if self._side == "left" else three.wrist
        model, betas = self._scene.hand_model(self._side), self._scene.hand_betas(self._side)
        return acceleration(model.skeleton(betas, three.hand_pose, three.global_orient, wrist).joints)

    def _better_alone(self, end: list[int], carried: Tried) -> list[int]:
        """The frames of a loose end, inwards, of which the grasp lets go."""
        for place, frame in enumerate(end):
            if not self._now.price[frame] < self._stage.loose_gain * carried.mismatch[frame]:
                return end[:place]
        return end

    def _write(self, let_go: list[int], carried_wrists: Tensor) -> None:
        own = self._scene.hand_poses[self._side]
        self._scene.grasps[self._side].release(let_go)
        own.has_expected_depth[let_go] = True
        own.expected_log_depth[let_go] = carried_wrists[let_go, 2].log()
        renewed = torch.tensor(sorted(self._renewed), dtype=torch.long)
        own.restart_frames(renewed, poses_at(self._now.poses, renewed))


def _cheapest(prices: Tensor, among: Tensor, most: int) -> Tensor:
    """Places of the `most` lowest of N prices [N] where `among` [N] (bool) says so."""
    places = torch.nonzero(among).flatten()
    return places[prices[places].argsort()[:most]]

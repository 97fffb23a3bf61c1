"""Grasps: where they are found, what they tie together, and what they leave alone."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_scenes import turning_scene

from bigs.checks import InputError
from bigs.geometry.rotations import axis_angle_to_matrix, robust_mean_rotation, rotation_angle
from bigs.hand import mirror_rotation
from bigs.models.poses import HandFrames, ObjectFrames
from bigs.models.scene import Scene
from bigs.train.check_plan import check_plan
from bigs.train.grasps.find import (
    _at_rest,
    _parts,
    find_grasps,
)
from bigs.train.plan.config import GraspStage, RunConfig
from bigs.types import Side

STAGE = GraspStage()
FRAMES = 24


def turning_copy(scene: Scene) -> Scene:
    return copy.deepcopy(scene)


EVERYWHERE = {"right": torch.ones(FRAMES), "left": torch.ones(FRAMES)}
ALL = torch.arange(FRAMES)


def test_the_object_carries_hands_that_hold_it() -> None:
    scene = turning_scene(wander=0.0008)
    truth = turning_scene()
    found = find_grasps(scene, GraspStage(slack=0.0), EVERYWHERE)
    assert {side: grasps.stretches for side, grasps in found.items()} == {
        "right": [range(0, FRAMES)],
        "left": [range(0, FRAMES)],
    }
    for side in scene.sides:
        joints = scene.at(ALL).in_object_frame(scene.at(ALL).joints(side))
        assert (joints - joints[:1]).abs().max() < 1e-5, "still in the object's frame"
        error = scene.at(ALL).joints(side) - truth.at(ALL).joints(side)
        assert error.norm(dim=-1).max() < 0.0008, "a mean of 24 frames is nearer than any of them"


def test_a_grasp_moves_as_one_and_a_frame_only_by_its_slack() -> None:
    scene = turning_scene()
    find_grasps(scene, GraspStage(slack=0.1), EVERYWHERE)
    before = scene.at(ALL).joints("left")
    with torch.no_grad():
        scene.grasps["left"].position[0] += torch.tensor([0.01, 0.0, 0.0])
    shift = scene.at(ALL).joints("left") - before
    torch.testing.assert_close(shift.norm(dim=-1), torch.full((FRAMES, 21), 0.01), atol=1e-5, rtol=0)
    with torch.no_grad():
        scene.grasps["left"].position.zero_()
        scene.hand_poses["left"].position.log_depth[3] = math.log(1.1) / 0.1
    wrists = scene.at(ALL).joints("left")[:, 0]
    ratio = wrists[:, 2] / before[:, 0, 2]
    torch.testing.assert_close(ratio[3], torch.tensor(1.1), atol=1e-5, rtol=0)
    torch.testing.assert_close(ratio[4:], torch.ones(FRAMES - 4), atol=1e-5, rtol=0)


def test_finding_again_changes_nothing() -> None:
    scene = turning_scene(wander=0.0008)
    find_grasps(scene, GraspStage(slack=0.0), EVERYWHERE)
    before = {side: scene.at(ALL).joints(side) for side in scene.sides}
    find_grasps(scene, GraspStage(slack=0.0), EVERYWHERE)
    for side in scene.sides:
        torch.testing.assert_close(scene.at(ALL).joints(side), before[side], atol=1e-5, rtol=0)


def test_a_hand_that_holds_nothing_stays_where_it_was() -> None:
    scene = turning_scene(wander=0.0008)
    with torch.no_grad():
        scene.hand_poses["right"].pose[:, 3, 2] = 0.2
        scene.hand_poses["right"].pose_bias[4, 1] = 0.1
    before = scene.at(ALL).joints("right")
    found = find_grasps(scene, STAGE, {"right": torch.zeros(FRAMES), "left": torch.zeros(FRAMES)})
    assert all(grasps.stretches == [] and not grasps.certainty.any() for grasps in found.values())
    torch.testing.assert_close(scene.at(ALL).joints("right"), before, atol=1e-6, rtol=0)
    assert not scene.hand_poses["right"].pose.any(), "residuals became the start"


def test_pictures_give_a_grasp_the_frames_that_faulty_estimates_lost() -> None:
    """The estimates stray for the last eight frames; carried there, the hand still fits its masks."""
    scene, truth = turning_scene(), turning_scene()
    lost = torch.arange(FRAMES) >= FRAMES - 8
    wrong = 0.02 * torch.arange(FRAMES)[:, None] * lost[:, None]
    true = truth.at(ALL).hand("right").wrist
    with torch.no_grad():
        scene.hand_poses["right"].position.restart(true + wrong)

    def mismatch(side: Side, poses: HandFrames, frames: torch.Tensor) -> torch.Tensor:
        return (poses.wrist - truth.at(ALL).hand(side).wrist).norm(dim=-1) / 0.01

    alone = find_grasps(copy.deepcopy(scene), STAGE, EVERYWHERE)["right"]
    assert alone.stretches == [range(0, FRAMES - 8)]
    found = find_grasps(scene, STAGE, EVERYWHERE, mismatch)["right"]
    assert found.stretches == [range(0, FRAMES)]
    assert found.certainty.min() > 0.85 and found.certainty[:8].min() > 0.95
    assert found.text() == f"0-{FRAMES - 1} (95%)"
    error = (scene.at(ALL).joints("right") - truth.at(ALL).joints("right")).norm(dim=-1)
    assert error.max() < 0.002
    torch.testing.assert_close(scene.grasps["right"].certainty, found.certainty)


@pytest.mark.parametrize("ends", ["", "seen to leave", "without touch"])
def test_estimates_alone_make_no_two_grasps_of_one(ends: str) -> None:
    """The estimates are beside each other before and after; masks allow either."""
    scene, stage = turning_scene(), replace(STAGE, gap=2, grasp=4.0)
    aside = 0.05 * ((ALL - 11.5) / 3).clamp(0, 1)
    with torch.no_grad():
        at = scene.at(ALL)
        beside = at.hand("right").wrist + aside[:, None] * at.object.rotations[..., 0]
        scene.hand_poses["right"].position.restart(beside)
    between = (ALL >= 12) & (ALL < 14)
    touching = {**EVERYWHERE, "right": (~between).float()} if ends == "without touch" else EVERYWHERE

    def mismatch(side: Side, poses: HandFrames, frames: torch.Tensor) -> torch.Tensor:
        carried = not torch.equal(poses.wrist, scene.at(ALL).hand(side).wrist)
        leaves = between[frames] if ends == "seen to leave" and carried else torch.zeros(FRAMES)
        return torch.where(leaves > 0, 1.0, 0.02)

    alone = find_grasps(copy.deepcopy(scene), stage, touching)["right"]
    assert len(alone.stretches) == 2
    found = find_grasps(scene, stage, touching, mismatch)["right"]
    assert len(found.stretches) == (2 if ends else 1)


def test_pictures_drop_a_grasp_that_they_contradict() -> None:
    # Estimates that waver, so that a hand that is carried is not where it was.
    scene = turning_scene(wander=0.0008)
    touching = {"right": torch.ones(FRAMES), "left": torch.ones(FRAMES)}

    def mismatch(side: Side, poses: HandFrames, frames: torch.Tensor) -> torch.Tensor:
        carried = not torch.equal(poses.wrist, scene.at(ALL).hand(side).wrist)
        return torch.full((FRAMES,), 2.0 if carried and side == "left" else 0.02)

    found = find_grasps(scene, STAGE, touching, mismatch)
    assert found["left"].stretches == [] and found["right"].stretches == [range(0, FRAMES)]


def waiting_scene(aside: float, drift: float = 0.0) -> Scene:
    """The object rests for ten frames and turns afterwards. The right hand is `aside` metres away from where
    it holds on, comes nearer in frames 9 to 14, and holds on from then on.

    Args:
        drift: metres by which the object moves in each of the first ten frames, and hands with it.
    """
    scene = turning_scene()
    at = scene.at(ALL)
    with torch.no_grad():
        held = {side: at.in_object_frame(at.hand(side).wrist[:, None])[:1] for side in scene.sides}
        turn = 0.15 * (ALL - 9.0).clamp_min(0.0)
        rotations = axis_angle_to_matrix(torch.stack([0 * turn, turn, 0 * turn], -1))
        scene.object_poses.base_orient.copy_(rotations)
        moved = torch.tensor([0.0, drift, 0.0]) * ALL.clamp(max=9)[:, None]
        scene.object_poses.position.restart(at.object.centers + moved)
        at = scene.at(ALL)
        away = aside * (1.0 - (ALL - 8.0) / 6.0).clamp(0.0, 1.0)
        for side in scene.sides:
            wrist = (rotations @ (at.object.scale * held[side][0, 0])[:, None])[..., 0] + at.object.centers
            wrist = wrist + (away if side == "right" else 0.0 * away)[:, None] * torch.tensor([0.0, 1.0, 0.0])
            poses = scene.hand_poses[side]
            poses.base_orient.copy_(mirror_rotation(rotations) if side == "left" else rotations)
            poses.position.restart(wrist)
    return scene


@pytest.mark.parametrize(
    ("aside", "drift", "held"),
    [
        (0.03, 0.0, [range(15, FRAMES - 2)]),  # both rest: nothing says that it holds on
        (0.03, 0.002, [range(0, 9), range(14, FRAMES - 2)]),  # it moves with the object: a grasp elsewhere
        (0.0, 0.0, [range(0, FRAMES - 2)]),  # it rests where it holds the object afterwards
    ],
)
def test_a_still_hand_on_a_still_object_proves_no_grasp(
    aside: float, drift: float, held: list[range]
) -> None:
    scene, truth = waiting_scene(aside, drift), waiting_scene(aside, drift)

    def mismatch(side: Side, poses: HandFrames, frames: torch.Tensor) -> torch.Tensor:
        return (poses.wrist - truth.at(ALL).hand(side).wrist).norm(dim=-1) / 0.01

    # It lets go in the end, so that its last grasp costs something.
    touching = {side: (ALL < FRAMES - 2).float() for side in scene.sides}
    found = find_grasps(scene, STAGE, touching, mismatch)["right"].stretches
    assert len(found) == len(held)
    for a, b in zip(found, held, strict=True):
        assert abs(a.start - b.start) <= 1 and abs(a.stop - b.stop) <= 1


def test_a_slow_grasp_is_none_that_rests() -> None:
    """Pictures hardly tell, but the object moves, and so somebody moves it."""
    scene, truth = waiting_scene(0.06, 0.0008), waiting_scene(0.06, 0.0008)

    def mismatch(side: Side, poses: HandFrames, frames: torch.Tensor) -> torch.Tensor:
        return (poses.wrist - truth.at(ALL).hand(side).wrist).norm(dim=-1) / 0.1

    found = find_grasps(scene, STAGE, EVERYWHERE, mismatch)["right"].stretches
    assert len(found) == 2 and found[0].start == 0 and abs(found[0].stop - 9) <= 1


@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize(
    ("drift", "rests"),
    [
        (0.0002, True),  # as tracks err
        (0.001, False),  # as slow as anybody moves what they hold
    ],
)
def test_an_object_rests_that_moves_no_more_than_tracks_err(drift: float, rests: bool, turns: bool) -> None:
    # It is put down in frame 5.
    way = drift * ALL + 0.01 * (ALL - 5).clamp_max(0)
    joints = torch.tensor([0.1, 0.0, 0.5]).expand(FRAMES, 11, 3)
    centers = torch.tensor([0.0, 0.0, 0.5]).expand(FRAMES, 3)
    turn = torch.stack([0 * way, way / 0.1, 0 * way], -1)
    moves = way[:, None] * torch.tensor([0.6, 0.0, 0.8])
    carrier = ObjectFrames(
        axis_angle_to_matrix(turn if turns else 0 * turn),
        centers if turns else centers + moves,
        torch.tensor(1.0),
    )
    still = _at_rest(carrier, joints, 8)
    assert still.tolist() == [rests and t >= 5 for t in range(FRAMES)]


def test_an_object_that_never_moves_is_held_by_who_touches_it() -> None:
    scene = waiting_scene(0.0)
    with torch.no_grad():
        still = scene.at(ALL).object
        scene.object_poses.base_orient.copy_(still.rotations[:1].expand(FRAMES, 3, 3))
        for side in scene.sides:
            wrist = scene.at(ALL).hand(side).wrist[:1].expand(FRAMES, 3)
            scene.hand_poses[side].base_orient.copy_(torch.eye(3).expand(FRAMES, 3, 3))
            scene.hand_poses[side].position.restart(wrist.clone())
    touching = {side: (ALL < 20).float() for side in scene.sides}

    def mismatch(side: Side, poses: HandFrames, frames: torch.Tensor) -> torch.Tensor:
        return torch.full((FRAMES,), 0.02)

    found = find_grasps(scene, STAGE, touching, mismatch)
    assert [found[side].stretches for side in scene.sides] == [[range(0, 20)], [range(0, 20)]]


def test_parts_of_stretches_that_are_chosen() -> None:
    chosen = np.array([1, 1, 1, 0, 1, 1, 0, 0, 1, 1, 1, 1], dtype=bool)
    assert _parts([range(0, 12)], chosen, 3) == [range(0, 3), range(8, 12)]
    assert _parts([range(1, 5), range(3, 10), range(4, 7)], chosen, 2) == [
        range(1, 3),
        range(4, 6),
        range(8, 10),
    ]
    assert _parts([], chosen, 1) == [] == _parts([range(3, 4)], chosen, 1)


def test_a_hand_metres_away_holds_nothing() -> None:
    """Carried through a turn it could end behind the camera."""
    scene = turning_scene()
    with torch.no_grad():
        far = scene.at(ALL).hand("right").wrist + torch.tensor([0.0, 0.0, 30.0])
        scene.hand_poses["right"].position.restart(far)
    found = find_grasps(scene, STAGE, EVERYWHERE)
    assert found["right"].stretches == [] and found["left"].stretches == [range(0, FRAMES)]


def test_gradients_of_a_held_hand_reach_grasp_and_object() -> None:
    scene = turning_scene()
    find_grasps(scene, STAGE, EVERYWHERE)
    scene.at(torch.tensor([2])).joints("right").square().sum().backward()
    grasps = scene.grasps["right"]
    for parameter in (grasps.orient, grasps.pose, grasps.position):
        assert parameter.grad[0].abs().max() > 0 and not parameter.grad[1:].any()
    assert scene.object_poses.orient.grad[2].abs().max() > 0
    assert not scene.object_poses.orient.grad[3].any()


def test_a_robust_mean_ignores_a_minority() -> None:
    generator = torch.Generator().manual_seed(0)
    good = axis_angle_to_matrix(0.02 * torch.randn(9, 3, generator=generator))
    bad = axis_angle_to_matrix(torch.tensor([[2.0, 0.0, 0.0]])).repeat(3, 1, 1)
    mean = robust_mean_rotation(torch.cat([good, bad]))
    assert rotation_angle(mean) < 0.05


@pytest.mark.parametrize(
    ("name", "value"),
    [("free", 0.0), ("least", 1), ("slack", -0.1), ("gap", -1), ("longest_move", -1), ("excess", 0.0)],
)
def test_thresholds_out_of_range_are_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"stages.grasps.{name}"):
        check_plan(RunConfig(stages=(GraspStage(**{name: value}),)))

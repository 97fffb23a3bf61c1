"""Frames between grasps: a hand caught in a wrong pose is found again, and nothing else moves."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor
from toy_scenes import cube_scene

from bigs.checks import InputError
from bigs.fused.fingers import finger_costs
from bigs.fused.outline import covered_shares
from bigs.geometry.rotations import axis_angle_to_matrix, rotation_angle
from bigs.hand import HandModel
from bigs.models.poses import HandFrames, ObjectFrames
from bigs.models.scene import Scene
from bigs.train.check_plan import check_plan
from bigs.train.grasps.find import Mismatch
from bigs.train.loop.evidence import EvidenceSource
from bigs.train.loop.targets import Targets
from bigs.train.moves.search import search_moves
from bigs.train.moves.trials import Trials
from bigs.train.plan.config import GraspDepthStage, MoveStage, RunConfig
from bigs.train.plan.presets import FAST
from bigs.types import SIDES, Side

FRAMES = 7
ALL = torch.arange(FRAMES)
STAGE = next(stage for stage in FAST.stages if isinstance(stage, MoveStage))
PALM = torch.tensor([0.0, 1.0, 0.0])


@pytest.fixture
def waving(both_hands: Mapping[Side, HandModel]) -> Scene:
    """Two open hands that slowly turn, palms towards the camera, 160 x 120 pixels."""
    scene = cube_scene(both_hands, frames=FRAMES)
    scene.K[:2] *= 2.0
    scene.width, scene.height = 160, 120
    scene.object_splats = None
    facing = axis_angle_to_matrix(torch.tensor([[1.4, 0.0, 0.0]]))
    turn = axis_angle_to_matrix(torch.linspace(0.0, 0.3, FRAMES)[:, None] * PALM)
    for side in SIDES:
        away = torch.tensor([0.06 if side == "right" else -0.06, 0.0, 0.5])
        still = scene.hand_poses[side].base_pose
        scene.hand_poses[side].restart(HandFrames(facing @ turn, still.clone(), away.repeat(FRAMES, 1)))
    return scene


def pictures_of(scene: Scene) -> EvidenceSource:
    """What masks say of the scene as it is."""

    def shown(side: Side) -> Tensor:
        faces = scene.hand_model(side).faces
        return covered_shares(scene.at(ALL).verts(side), faces, scene.K, scene.width, scene.height)

    with torch.no_grad():
        shares = {side: shown(side) for side in SIDES}
    images = torch.zeros(FRAMES, scene.height, scene.width, 3)
    targets = Targets(images, shares, torch.zeros_like(images[..., 0]), scene.K, scene.width, scene.height)
    given = SimpleNamespace(clip=range(FRAMES), unknown=None, at=lambda size: targets)
    return EvidenceSource(given, scene, RunConfig(), None)


def a_finger_over(scene: Scene, side: Side, frame: int) -> None:
    """Turn a hand in the palm's plane by about a finger's width."""
    with torch.no_grad():
        turned = axis_angle_to_matrix(0.24 * PALM)
        scene.hand_poses[side].base_orient[frame] = scene.hand_poses[side].base_orient[frame] @ turned


def angles(scene: Scene, truth: Scene, side: Side) -> Tensor:
    return rotation_angle(
        scene.at(ALL).hand(side).global_orient.transpose(-1, -2) @ truth.at(ALL).hand(side).global_orient
    )


@pytest.mark.parametrize("side", SIDES)
def test_a_hand_with_fingers_where_their_neighbours_belong_is_found_again(waving: Scene, side: Side) -> None:
    truth, sources = copy.deepcopy(waving), pictures_of(waving)
    a_finger_over(waving, side, 3)
    evidence, mismatch = sources.evidence(STAGE), sources.mismatch(STAGE)
    at = torch.tensor([3])
    stuck = Trials(waving, side, STAGE, evidence, mismatch).fit(
        at, waving.at(at).hand(side), sum(STAGE.trial_steps)
    )
    found = search_moves(waving, STAGE, evidence, mismatch)
    assert found[side] == (FRAMES, 1, [])
    now = mismatch(side, waving.at(at).hand(side), at)
    assert now < 0.2 * stuck.mismatch, "steps alone do not lead there"
    assert angles(waving, truth, side)[3] < 0.05
    others = ALL != 3
    for hand in SIDES:
        moved = waving.hand_poses[hand].state_dict()
        for name, value in truth.hand_poses[hand].state_dict().items():
            rows = others if hand == side and name != "pose_bias" else slice(None)
            assert torch.equal(moved[name][rows], value[rows]), (hand, name)


def test_poses_spread_through_a_run_of_wrong_frames(waving: Scene) -> None:
    truth, sources = copy.deepcopy(waving), pictures_of(waving)
    for frame in (2, 3, 4):
        a_finger_over(waving, "right", frame)
    found = search_moves(waving, STAGE, sources.evidence(STAGE), sources.mismatch(STAGE))
    assert found["right"].renewed == 3 and found["right"].text().startswith("another pose in 3 of 7 frames")
    assert angles(waving, truth, "right").max() < 0.05
    # What the pose prior draws to from now on.
    assert not waving.hand_poses["right"].orient.any() and not waving.hand_poses["right"].pose.any()


@pytest.mark.parametrize(("exact", "renewed"), [(STAGE.exact, 0), (0.0, 1)])
def test_an_outline_a_fraction_of_a_pixel_off_is_right(waving: Scene, exact: float, renewed: int) -> None:
    """Beside perfect ones any other is many times as far off as usual."""
    sources = pictures_of(waving)
    with torch.no_grad():
        waving.hand_poses["right"].base_orient[3] = waving.hand_poses["right"].base_orient[
            3
        ] @ axis_angle_to_matrix(0.006 * PALM)
    mismatch = sources.mismatch(STAGE)
    off = mismatch("right", waving.at(ALL).hand("right"), ALL)
    assert 0.001 < off[3] < STAGE.exact and off.median() < 0.1 * off[3]
    stage = replace(STAGE, exact=exact)
    found = search_moves(waving, stage, sources.evidence(stage), mismatch)
    assert found["right"].renewed == renewed


def test_what_all_frames_share_stays_when_some_start_anew(waving: Scene) -> None:
    poses = waving.hand_poses["right"]
    with torch.no_grad():
        poses.pose_bias.fill_(0.1)
        poses.pose.fill_(0.2)
    before, some = waving.at(ALL).hand("right"), torch.tensor([1, 4])
    poses.restart_frames(some, HandFrames(*(part[some] for part in before)))
    for old, new in zip(before, waving.at(ALL).hand("right"), strict=True):
        torch.testing.assert_close(new, old, atol=1e-6, rtol=0)
    assert torch.equal(poses.pose_bias, torch.full((15, 3), 0.1))


def still(scene: Scene) -> ObjectFrames:
    return scene.at(ALL).object


def test_a_grasp_lets_go_of_a_frame_that_belongs_to_the_move(waving: Scene) -> None:
    """Held frames 0 to 5; in the last of them the hand has turned away by what another pose explains."""
    with torch.no_grad():
        waving.hand_poses["right"].base_orient[:5] = waving.hand_poses["right"].base_orient[:1].clone()
        waving.hand_poses["right"].base_orient[5] = waving.hand_poses["right"].base_orient[6]
    truth, sources = copy.deepcopy(waving), pictures_of(waving)
    of_frame = torch.tensor([0, 0, 0, 0, 0, 0, -1])
    waving.grasps["right"].set(of_frame, 0.0, waving.at(ALL).hand("right"), still(waving))
    assert angles(waving, truth, "right")[5] > 0.2, "the object carries the hand of the other frames there"
    found = search_moves(waving, STAGE, sources.evidence(STAGE), sources.mismatch(STAGE))["right"]
    assert found == (2, 1, [5]) and "1 of which was in one" in found.text()
    assert waving.grasps["right"].of_frame.tolist() == [0, 0, 0, 0, 0, -1, -1]
    assert waving.grasps["right"].certainty.tolist() == [1, 1, 1, 1, 1, 0, 0]
    assert waving.hand_poses["right"].has_expected_depth.tolist() == [False] * 5 + [True, False]
    assert angles(waving, truth, "right").max() < 0.08


def test_a_grasp_keeps_frames_that_no_pose_explains(waving: Scene) -> None:
    """An outline that is wrong whatever the hand does is no reason to let go."""
    of_frame = torch.tensor([0, 0, 0, 0, 0, 0, -1])
    waving.grasps["right"].set(of_frame, 0.0, waving.at(ALL).hand("right"), still(waving))
    sources = pictures_of(waving)
    asked = sources.mismatch(STAGE)

    def mismatch(side: Side, poses: HandFrames, frames: Tensor) -> Tensor:
        return asked(side, poses, frames) + 2.0 * (frames == 5)

    before = copy.deepcopy(waving.state_dict())
    found = search_moves(waving, STAGE, sources.evidence(STAGE), mismatch)["right"]
    assert found.let_go == [] and waving.grasps["right"].of_frame.tolist() == of_frame.tolist()
    held = of_frame >= 0
    for name in ("base_orient", "base_pose", "orient", "pose"):
        key = f"hand_poses.right.{name}"
        assert torch.equal(waving.state_dict()[key][held], before[key][held])


def test_frames_without_masks_neither_try_nor_lend(waving: Scene) -> None:
    sources = pictures_of(waving)
    asked = sources.mismatch(STAGE)

    def mismatch(side: Side, poses: HandFrames, frames: Tensor) -> Tensor:
        return torch.where((frames == 2) | (frames == 3), torch.nan, asked(side, poses, frames))

    a_finger_over(waving, "right", 3)
    before = copy.deepcopy(waving.state_dict())
    found = search_moves(waving, STAGE, sources.evidence(STAGE), mismatch)
    assert found["right"].renewed == 0
    assert all(torch.equal(value, before[name]) for name, value in waving.state_dict().items())


def test_a_single_frame_is_left_alone(both_hands: Mapping[Side, HandModel]) -> None:
    scene = cube_scene(both_hands, frames=1)
    constant: Mismatch = lambda side, poses, frames: poses.wrist[:, 2] * 0.0 + 0.1  # noqa: E731
    evidence = SimpleNamespace(
        impossible_turns={side: torch.zeros(22, 15, 3, 3) for side in SIDES},
        bends={side: torch.eye(3).expand(2, 2, 4, 15, 3, 3) for side in SIDES},
    )
    found = search_moves(scene, STAGE, evidence, constant)
    assert all(moved == (1, 0, []) for moved in found.values())


def test_trials_know_nothing_of_each_other(waving: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    sources = pictures_of(waving)
    for frame in (1, 3, 4):
        a_finger_over(waving, "left", frame)
    frames = torch.tensor([1, 3, 3, 4])
    starts = waving.at(torch.tensor([1, 2, 3, 5])).hand("left")
    trials = Trials(waving, "left", STAGE, sources.evidence(STAGE), sources.mismatch(STAGE))
    together = trials.fit(frames, starts, 5)
    monkeypatch.setattr("bigs.train.moves.trials._TOGETHER", 1)
    alone = trials.fit(frames, starts, 5)
    for one, other in zip((*together.poses, *together[1:]), (*alone.poses, *alone[1:]), strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


def only_frame_3(asked: Mismatch) -> Mismatch:
    """What pictures say of frame 3, and nothing of the others."""

    def mismatch(side: Side, poses: HandFrames, frames: Tensor) -> Tensor:
        return torch.where(frames == 3, asked(side, poses, frames), torch.where(frames == 0, 0.0, torch.nan))

    return mismatch


def test_a_frame_without_neighbours_to_learn_from_turns_its_own_pose(waving: Scene) -> None:
    truth, sources = copy.deepcopy(waving), pictures_of(waving)
    a_finger_over(waving, "right", 3)
    mismatch = only_frame_3(sources.mismatch(STAGE))
    unturned = copy.deepcopy(waving)
    search_moves(waving, STAGE, sources.evidence(STAGE), mismatch)
    assert angles(waving, truth, "right")[3] < 0.05
    search_moves(unturned, replace(STAGE, turn=0.0), sources.evidence(STAGE), mismatch)
    assert angles(unturned, truth, "right")[3] > 0.1


@pytest.mark.parametrize(
    "changes", [{"rounds": 0}, {"worse": 1e6}, {"gain": 0.0}, {"weights": {"acceleration": 1e6}}]
)
def test_settings_that_stop_frames_from_trying(waving: Scene, changes: dict) -> None:
    """A hand that jerks in one picture is followed there unless a setting speaks against it."""
    jerking = copy.deepcopy(waving)
    a_finger_over(jerking, "right", 3)
    sources = pictures_of(jerking)
    asked, evidence = sources.mismatch(STAGE), sources.evidence(STAGE)

    def mismatch(side: Side, poses: HandFrames, frames: Tensor) -> Tensor:
        return asked(side, poses, frames) + 0.002  # masks are never quite right

    stopped = search_moves(copy.deepcopy(waving), replace(STAGE, **changes), evidence, mismatch)
    assert stopped["right"].renewed == 0
    assert search_moves(waving, STAGE, evidence, mismatch)["right"].renewed == 1


@pytest.mark.parametrize("changes", [{"loose_frames": 0}, {"loose": 1e6}, {"loose_gain": 0.0}])
def test_settings_that_keep_a_grasp_whole(waving: Scene, changes: dict) -> None:
    with torch.no_grad():
        waving.hand_poses["right"].base_orient[:5] = waving.hand_poses["right"].base_orient[:1].clone()
        waving.hand_poses["right"].base_orient[5] = waving.hand_poses["right"].base_orient[6]
    sources = pictures_of(waving)
    of_frame = torch.tensor([0, 0, 0, 0, 0, 0, -1])
    waving.grasps["right"].set(of_frame, 0.0, waving.at(ALL).hand("right"), still(waving))
    stage = replace(STAGE, **changes)
    found = search_moves(waving, stage, sources.evidence(stage), sources.mismatch(stage))
    assert found["right"].let_go == [] and waving.grasps["right"].of_frame.tolist() == of_frame.tolist()


def test_trials_take_the_steps_and_the_best_that_the_stage_names(
    waving: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = pictures_of(waving)
    a_finger_over(waving, "right", 3)
    asked: list[tuple[int, int]] = []
    fit = Trials.fit

    def watched(self: Trials, frames: Tensor, starts: HandFrames, steps: int) -> object:
        asked.append((len(frames), steps))
        return fit(self, frames, starts, steps)

    monkeypatch.setattr(Trials, "fit", watched)
    stage = replace(STAGE, trial_steps=(2, 3), best=4, rounds=1)
    search_moves(waving, stage, sources.evidence(stage), sources.mismatch(stage))
    # Both neighbours and the frame itself, each turned three ways.
    assert asked == [(9, 2), (4, 3)]


def test_prices_add_up(waving: Scene) -> None:
    """A pose on trial pays for the mismatch and for each prior by its weight."""
    sources = pictures_of(waving)
    mismatch = sources.mismatch(STAGE)
    bent = waving.at(ALL).hand("right")
    bent = bent._replace(hand_pose=bent.hand_pose @ axis_angle_to_matrix(torch.tensor([0.0, 0.0, 0.1])))
    prices = {}
    for name in ("pose_prior", "fingers_even", "joint_axes", "finger_tendons"):
        stage = replace(STAGE, weights={name: 1.0})
        tried = Trials(waving, "right", stage, sources.evidence(stage), mismatch).price(ALL, bent)
        torch.testing.assert_close(tried.mismatch, mismatch("right", bent, ALL))
        prices[name] = tried.price - tried.mismatch
    torch.testing.assert_close(prices["pose_prior"], torch.full((FRAMES,), 0.01), atol=1e-4, rtol=0)
    evidence = sources.evidence(STAGE)
    costs = finger_costs(bent.hand_pose, evidence.impossible_turns["right"], evidence.bends["right"])
    for name, cost in zip(("fingers_even", "joint_axes", "finger_tendons"), costs, strict=True):
        torch.testing.assert_close(prices[name].mean(), cost, atol=1e-5, rtol=1e-3)
    every = Trials(waving, "right", STAGE, sources.evidence(STAGE), mismatch).price(ALL, bent)
    expected = sum(STAGE.weights[name] * price for name, price in prices.items())
    torch.testing.assert_close(every.price - every.mismatch, expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lrs": {"hand.betas": 0.1}}, "hand.betas"),
        ({"weights": {"image": 1.0}}, "image"),
        ({"gain": 1.5}, "gain: expected 0 to 1, found 1.5"),
        ({"best": 0}, "best: expected 1"),
    ],
)
def test_stages_that_cannot_run_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        check_plan(replace(FAST, stages=(*FAST.stages[:2], replace(STAGE, **changes))))


def test_an_outline_that_is_seen_whole_tells_depth_against_what_is_expected(waving: Scene) -> None:
    """A hand swings out by 4 % of its depth between grasps, where neither way nor estimate expects it."""
    sources, at = pictures_of(waving), torch.tensor([3])
    poses, off = waving.hand_poses["right"], 0.04
    start = waving.at(at).hand("right")
    with torch.no_grad():
        poses.has_expected_depth[at] = True
        poses.expected_log_depth[at] = start.wrist[:, 2].log() + off
    start = start._replace(wrist=start.wrist * torch.tensor(off).exp())
    trials = Trials(waving, "right", STAGE, sources.evidence(STAGE), sources.mismatch(STAGE))
    found = trials.fit(at, start, 200).poses.wrist[:, 2].log() - (poses.expected_log_depth[at] - off)
    assert found.abs() < 0.15 * off


def test_how_much_of_a_hand_its_mask_shows(waving: Scene) -> None:
    sources = pictures_of(waving)
    shares = sources.targets.at(0).shares["left"]
    whole = sources.seen(GraspDepthStage())
    assert all((share > 0.85).all() and (share <= 1.0).all() for share in whole.values())
    shares[2, :, :70] = 0.0
    shares[4] = 0.0
    less = sources.seen(GraspDepthStage())
    torch.testing.assert_close(less["right"], whole["right"])
    others = [0, 1, 3, 5, 6]
    torch.testing.assert_close(less["left"][others], whole["left"][others])
    kept = shares[2].square().sum() / pictures_of(waving).targets.at(0).shares["left"][2].sum()
    assert 0.05 < float(kept) < 0.8
    torch.testing.assert_close(less["left"][2], kept, rtol=1e-3, atol=0)
    assert less["left"][4] == 0.0

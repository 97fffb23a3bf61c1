"""The depths of grasps and the object's size, from fingers that touch a cube's front."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from toy_scenes import CENTER, HALF, cube_scene, turning_scene

from bigs.fused.touch import Touch
from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.hand import HandModel
from bigs.models.posed_scene import PosedScene
from bigs.models.scene import Scene
from bigs.train.fit import _not_needed
from bigs.train.fit_report import FitReport
from bigs.train.grasps.depth_search import _costs, _error, _Grasp, _move, _sights, search_grasp_depths
from bigs.train.plan.config import GraspDepthStage
from bigs.types import Side

STAGE = GraspDepthStage()
# Fingers decide against everything else.
FINGERS = replace(STAGE, weight=100.0)
FRAMES = torch.arange(6)
# Hands of which pictures show a third.
SEEN: dict[Side, torch.Tensor] = {"right": torch.full((6,), 0.35), "left": torch.full((6,), 0.35)}
TWO_GRASPS = torch.tensor([0, 0, 0, 1, 1, 1])
GRID_STEP = 2 * STAGE.span / (STAGE.candidates - 1)


@pytest.fixture
def held(both_hands: dict[Side, HandModel]) -> Scene:
    """Hands between the camera and a cube, in two grasps each, whose fingers reach its front."""
    scene = cube_scene(both_hands, frames=len(FRAMES))
    ahead = axis_angle_to_matrix(torch.tensor([[0.0, math.pi / 2, 0.0]])).expand(len(FRAMES), 3, 3)
    with torch.no_grad():
        for side in scene.sides:
            poses = scene.hand_poses[side]
            poses.base_orient.copy_(ahead)
            aside = 0.02 if side == "right" else -0.02
            wrist = torch.tensor(CENTER) + torch.tensor([0.0, aside, -HALF - 0.15])
            poses.position.restart(wrist.expand(len(FRAMES), 3))
        for side in scene.sides:
            scene.grasps[side].set(TWO_GRASPS, 0.0, scene.at(FRAMES).hand(side), scene.at(FRAMES).object)
    search_grasp_depths(scene, FINGERS, SEEN)
    return scene


@torch.no_grad()
def push(scene: Scene, side: Side, grasp: int, factor: float) -> None:
    """Move a grasp along its line of sight."""
    _move(scene, scene.at(FRAMES), _Grasp(side, grasp, grasp == TWO_GRASPS, 0.0), factor)


@torch.no_grad()
def depths(scene: Scene, side: Side) -> torch.Tensor:
    """The wrists' depths in both grasps."""
    return scene.at(FRAMES).hand(side).wrist[[0, 3], 2]


def test_what_was_found_is_found_again(held: Scene) -> None:
    found = search_grasp_depths(held, FINGERS, SEEN)
    assert found.size == pytest.approx(1.0, abs=1e-3)
    for side in held.sides:
        torch.testing.assert_close(found.moved[side], torch.ones(2), atol=2e-3, rtol=0)


@pytest.mark.parametrize("wrong", [0.92, 0.96, 1.05])
def test_a_grasp_that_is_off_comes_back_to_the_others(held: Scene, wrong: float) -> None:
    """One of four that is off also says a little about the size, and all go with it."""
    before = {side: depths(held, side) for side in held.sides}
    push(held, "left", 1, wrong)
    assert depths(held, "left")[1] == pytest.approx(wrong * before["left"][1])
    found = search_grasp_depths(held, FINGERS, SEEN)
    first, second = found.moved["left"].tolist()
    assert second * wrong == pytest.approx(first, abs=0.5 * GRID_STEP)
    assert found.size == pytest.approx(1.0, abs=0.25 * abs(1.0 - wrong))
    for side in held.sides:
        after = depths(held, side)
        near = before[side].mean().expand(2)
        torch.testing.assert_close(after, near, atol=0, rtol=0.4 * abs(1.0 - wrong))
        assert float(after[0]) == pytest.approx(float(after[1]), rel=0.5 * GRID_STEP)


def test_where_a_hand_was_counts_too(held: Scene) -> None:
    push(held, "left", 1, 1.05)
    assert 1.0 / 1.04 < float(search_grasp_depths(held, STAGE, SEEN).moved["left"][1]) < 1.0 / 1.01


@pytest.mark.parametrize("wrong", [0.93, 1.06])
def test_what_all_grasps_have_in_common_is_the_size(held: Scene, wrong: float) -> None:
    with torch.no_grad():
        held.object_poses.log_scale.add_(math.log(wrong))
        for side in held.sides:
            for grasp in range(2):
                push(held, side, grasp, 1.0 / wrong)
    before = {side: depths(held, side) for side in held.sides}
    found = search_grasp_depths(held, STAGE, SEEN)
    assert found.size == pytest.approx(1.0 / wrong, abs=0.02)
    for side in held.sides:
        torch.testing.assert_close(depths(held, side), before[side], atol=0, rtol=0.02)
    assert 0.0 <= found.spread < GRID_STEP, "all say the same"


def test_what_is_likely_decides_where_all_is_the_same(held: Scene) -> None:
    """Fingers of no weight leave everything where it was, however far away."""
    push(held, "right", 0, 1.2)
    before = {side: depths(held, side) for side in held.sides}
    found = search_grasp_depths(held, replace(STAGE, weight=0.0), SEEN)
    assert found.size == pytest.approx(1.0)
    for side in held.sides:
        torch.testing.assert_close(depths(held, side), before[side])


@pytest.mark.parametrize(
    ("hand", "fingers", "gap"),
    [
        (0.0, [0.0] * 4, 0.0),
        (0.02, [0.0] * 4, 0.5),
        (-0.02, [0.02, -0.02, 0.0, 0.0], 0.75),
        (0.0, [0.06] * 4, 0.75),
    ],
)
def test_the_hand_and_its_fingers_count_alike(
    held: Scene, monkeypatch: pytest.MonkeyPatch, hand: float, fingers: list[float], gap: float
) -> None:
    depths = torch.tensor([[hand, *fingers]]).expand(len(FRAMES), 5)
    touch = Touch(depths, torch.zeros(len(FRAMES)))
    monkeypatch.setattr(PosedScene, "touch", lambda self, side, carrier: touch)
    posed = held.at(FRAMES)
    grasps = [_Grasp("left", 1, TWO_GRASPS == 1, 0.0)]
    (costs,) = _costs(held, posed, grasps, torch.zeros(2), STAGE, lambda side, factor: posed.object)
    torch.testing.assert_close(costs, torch.full((2,), STAGE.weight * gap))


def test_a_grasp_that_is_not_sure_says_little(held: Scene) -> None:
    with torch.no_grad():
        held.grasps["left"].certainty[3:] = 0.01
    push(held, "left", 1, 0.95)
    found = search_grasp_depths(held, STAGE, SEEN)
    assert found.moved["left"][1] == pytest.approx(1.0, abs=0.5 * GRID_STEP)


def test_frames_stay_where_they_are_in_the_picture(held: Scene) -> None:
    """Those of grasps; and those outside stay altogether."""
    for side in held.sides:
        held.grasps[side].release([5])
    push(held, "right", 0, 0.95)
    before = {side: held.at(FRAMES).hand(side).wrist.clone() for side in held.sides}
    search_grasp_depths(held, STAGE, SEEN)
    for side in held.sides:
        after = held.at(FRAMES).hand(side).wrist
        torch.testing.assert_close(after[:, :2] / after[:, 2:], before[side][:, :2] / before[side][:, 2:])
        torch.testing.assert_close(after[5], before[side][5], rtol=0, atol=0)


def test_without_grasps_nothing_changes(both_hands: dict[Side, HandModel]) -> None:
    scene = cube_scene(both_hands, 0.9)
    before = {name: value.clone() for name, value in scene.state_dict().items()}
    found = search_grasp_depths(scene, STAGE, SEEN)
    assert found.size == 1.0
    assert math.isnan(found.spread)
    assert found.text_of("left") == "(none)"
    assert _not_needed(STAGE, scene, FitReport()) == "no hand holds the object"
    for name, value in scene.state_dict().items():
        assert torch.equal(value, before[name]), name


@torch.no_grad()
def test_a_grasp_seen_from_several_sides_is_known_better() -> None:
    def error(turn: float, seen: float) -> float:
        scene = turning_scene(frames=8, turn=turn)
        sights = _sights(scene.at(torch.arange(8)), "right", torch.ones(8, dtype=torch.bool))
        return _error(sights, torch.full((8,), seen), STAGE)

    still, some, much = error(0.0, 0.4), error(0.5, 0.4), error(2.0, 0.4)
    assert still == pytest.approx(STAGE.error_along / 0.4, rel=1e-3)
    assert STAGE.error_aside < much < 0.5 * some < 0.5 * still
    assert error(0.0, 1.0) == pytest.approx(STAGE.error_along, rel=1e-3)
    assert error(0.0, 0.0) == pytest.approx(STAGE.error_hidden, rel=1e-3)

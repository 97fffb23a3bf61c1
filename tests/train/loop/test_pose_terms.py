"""Terms of poses are means over both hands, of which each is asked."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from bigs.fused.fingers import finger_costs
from bigs.losses.temporal import acceleration
from bigs.models.scene import Scene
from bigs.train.loop.step import Evidence, Selection, Step
from bigs.train.loop.terms import TERMS
from bigs.types import Side


@pytest.fixture
def moving(scene: Scene) -> Scene:
    """Both hands bend and swing, the left one more."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for bend, poses in zip((0.2, 0.5), scene.hand_poses.values(), strict=True):
            poses.pose += bend * torch.randn(poses.pose.shape, generator=generator)
            poses.orient += bend * torch.randn(poses.orient.shape, generator=generator)
    return scene


def of_side(name: str, scene: Scene, evidence: Evidence, side: Side) -> Tensor:
    clip = scene.at(torch.arange(scene.n_frames))
    if name == "acceleration":
        return acceleration(clip.joints(side))
    costs = finger_costs(clip.hand(side).hand_pose, evidence.impossible_turns[side], evidence.bends[side])
    return {
        "fingers_even": costs.unevenness,
        "joint_axes": costs.impossible,
        "finger_tendons": costs.uncoupled,
    }[name]


@pytest.mark.parametrize("name", ["fingers_even", "joint_axes", "finger_tendons", "acceleration"])
def test_a_term_is_the_mean_of_what_it_says_of_each_hand(
    moving: Scene, evidence: Evidence, name: str
) -> None:
    right, left = (of_side(name, moving, evidence, side) for side in moving.sides)
    assert left > 1.2 * right > 0
    found = TERMS[name](Step(moving, evidence, {}, Selection(torch.arange(moving.n_frames))))
    torch.testing.assert_close(found, (right + left) / 2)


def in_turns(scene: Scene, evidence: Evidence, name: str, weights: Tensor) -> tuple[Tensor, Tensor]:
    """A term of touch in the whole clip, and in each of three steps, of hands that hold as surely as that."""
    count = scene.n_frames
    evidence = replace(evidence, contact="surface", touching=dict.fromkeys(scene.sides, weights))
    clip = scene.at(torch.arange(count))
    for side in scene.sides:
        held = torch.zeros(count, dtype=torch.long)
        scene.grasps[side].set(held, 0.1, clip.canonical_hand(side), clip.object, weights)
    some = (Selection(torch.tensor([0, 2]), seed=seed) for seed in range(3))
    whole, *each = (
        TERMS[name](Step(scene, evidence, {}, selection))
        for selection in (Selection(torch.arange(count)), *some)
    )
    return whole, torch.stack(each)


@pytest.mark.parametrize("name", ["contact", "finger_contact", "penetration"])
def test_steps_on_some_frames_measure_touch_in_turns(moving: Scene, evidence: Evidence, name: str) -> None:
    """Where all frames count alike, three steps together say what one on the whole clip does."""
    whole, each = in_turns(moving, evidence, name, torch.ones(3))
    assert len(each.unique()) > 1
    torch.testing.assert_close(each.mean(), whole)


@pytest.mark.parametrize("name", ["contact", "finger_contact"])
def test_the_turn_of_a_frame_without_touch_says_nothing(moving: Scene, evidence: Evidence, name: str) -> None:
    _, each = in_turns(moving, evidence, name, torch.tensor([1.0, 0.5, 0.0]))
    assert (each > 0.0).tolist() == [True, True, False]


@pytest.mark.parametrize("count", [2, 3, 4, 60])
def test_every_frame_has_its_turn(count: int) -> None:
    """However few there are: terms are means, and nothing has none."""
    scene = SimpleNamespace(n_frames=count)
    turns = [Step(scene, None, {}, Selection(torch.tensor([0]), seed=seed)).touch_frames for seed in range(6)]
    assert all(map(len, turns))
    assert torch.cat(turns[: min(count, 3)]).sort().values.tolist() == list(range(count))

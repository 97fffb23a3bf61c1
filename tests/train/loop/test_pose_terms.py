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


@pytest.mark.parametrize("name", ["contact", "finger_contact", "penetration"])
def test_steps_on_some_frames_measure_touch_in_turns(moving: Scene, evidence: Evidence, name: str) -> None:
    """Where all frames count alike, three steps together say what one on the whole clip does."""
    count = moving.n_frames
    evidence = replace(evidence, contact="surface", touching=dict.fromkeys(moving.sides, torch.ones(count)))
    clip = moving.at(torch.arange(count))
    for side in moving.sides:
        held = torch.zeros(count, dtype=torch.long)
        moving.grasps[side].set(held, 0.1, clip.canonical_hand(side), clip.object, torch.ones(count))
    whole = TERMS[name](Step(moving, evidence, {}, Selection(torch.arange(count))))
    some = [Step(moving, evidence, {}, Selection(torch.tensor([0, 2]), seed=seed)) for seed in range(3)]
    assert torch.cat([step.touch_frames for step in some]).sort().values.tolist() == list(range(count))
    each = torch.stack([TERMS[name](step) for step in some])
    assert len(each.unique()) > 1
    torch.testing.assert_close(each.mean(), whole)


@pytest.mark.parametrize("count", [2, 3, 4, 60])
def test_every_frame_has_its_turn(count: int) -> None:
    """However few there are: terms are means, and nothing has none."""
    scene = SimpleNamespace(n_frames=count)
    turns = [
        Step(scene, None, {}, Selection(torch.tensor([0]), seed=seed)).touch_frames
        for seed in range(min(count, 3))
    ]
    assert all(map(len, turns))
    assert torch.cat(turns).sort().values.tolist() == list(range(count))

"""Trainable groups: together they are the whole scene, each parameter in exactly one."""

from __future__ import annotations

import math
import subprocess
import sys
from collections import Counter
from dataclasses import replace

import pytest
import torch
from toy_scenes import cube_scene

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.models.scene import Scene
from bigs.train.loop.adam import FrameAdam
from bigs.train.loop.optim import FIELD_GROUPS, GROUPS, group_parameters, make_optimizer, set_rates
from bigs.train.plan.presets import SMOKE
from bigs.train.start.build import build_scene
from bigs.types import Side

BETAS = (0.9, 0.99)


def assert_partition(scene: Scene) -> None:
    names = {id(p): name for name, p in scene.named_parameters()}
    seen = Counter(names[id(p)] for group in GROUPS for p in group_parameters(scene, group))
    assert seen == Counter(names.values())


def test_groups_partition_the_parameters(both_hands: dict[Side, HandModel]) -> None:
    assert_partition(cube_scene(both_hands))


@pytest.mark.parametrize("case", ["one hand", "no object", "no light", "two canonical hands"])
def test_groups_partition_the_parameters_of_any_clip(
    case: str, tiny: Clip, both_hands: dict[Side, HandModel]
) -> None:
    hand = SMOKE.hand
    if case == "one hand":
        tiny = replace(tiny, hands={"left": tiny.hands["left"]})
    if case == "no object":
        tiny = replace(tiny, object=None)
    if case == "two canonical hands":
        hand = replace(hand, shared=False)
    unknown = torch.zeros(len(tiny), tiny.height, tiny.width, dtype=torch.bool).numpy()
    scene = build_scene(
        tiny, unknown, both_hands, SMOKE.initial, hand, SMOKE.object, case != "no light"
    ).scene
    assert_partition(scene)
    assert len(scene.hand_splats) == (2 if case == "two canonical hands" else 1)


def test_field_groups_are_what_a_canonical_subject_depends_on(both_hands: dict[Side, HandModel]) -> None:
    scene = cube_scene(both_hands)
    for subject, splats in (("hand", scene.hand_splats), ("object", scene.object_splats)):
        grouped = {id(p) for group in FIELD_GROUPS[subject] for p in group_parameters(scene, group)}
        assert grouped == {id(p) for p in splats.parameters()}


def test_an_unknown_group_is_named(both_hands: dict[Side, HandModel]) -> None:
    with pytest.raises(InputError, match=r"expected one of .* groups, found 'hand\.rays'"):
        make_optimizer(cube_scene(both_hands), {"hand.rays": 0.1}, BETAS)


def test_only_listed_groups_require_gradients(both_hands: dict[Side, HandModel]) -> None:
    scene = cube_scene(both_hands)
    make_optimizer(scene, {"hand.ray": 0.1, "object.ray": 0.2, "scene.light": 0.3}, BETAS)
    trainable = {name for name, p in scene.named_parameters() if p.requires_grad}
    assert trainable == {
        "hand_poses.right.position.ray",
        "hand_poses.left.position.ray",
        "object_poses.position.ray",
        "lighting.clip",
    }


def test_rates_fall_along_a_cosine(both_hands: dict[Side, HandModel]) -> None:
    optimizer = make_optimizer(cube_scene(both_hands), {"hand.ray": 0.5, "hand.depth": 2.0}, BETAS)
    for progress, share in ((0.0, 1.0), (0.5, 0.55), (0.25, 0.1 + 0.45 * (1 + math.sqrt(0.5))), (1.0, 0.1)):
        set_rates(optimizer, progress, 0.1)
        rates = {group["name"]: group["lr"] for group in optimizer.param_groups}
        assert rates == pytest.approx({"hand.ray": 0.5 * share, "hand.depth": 2.0 * share})


def test_rates_fall_by_the_same_factor(both_hands: dict[Side, HandModel]) -> None:
    """The released code's schedule of translations: 2e-3 to 2e-5, log-linear."""
    optimizer = make_optimizer(cube_scene(both_hands), {"hand.ray": 2e-3}, betas=(0.9, 0.999))
    assert optimizer.param_groups[0]["betas"] == (0.9, 0.999)
    for progress, rate in ((0.0, 2e-3), (0.5, 2e-4), (1.0, 2e-5)):
        set_rates(optimizer, progress, 0.01, decay="exponential")
        assert optimizer.param_groups[0]["lr"] == pytest.approx(rate)


def test_a_frame_outside_the_step_keeps_turns_and_moments(both_hands: dict[Side, HandModel]) -> None:
    scene = cube_scene(both_hands)
    optimizer = make_optimizer(
        scene, {"hand.pose": 0.1, "hand.depth": 0.1, "object.orient": 0.1}, BETAS, frame_moments=True
    )
    turns, depths = scene.hand_poses["right"].pose, scene.hand_poses["right"].position.log_depth
    others = list(range(1, scene.n_frames))

    def step(frame: int) -> None:
        optimizer.zero_grad()
        # As a prior over time has it, every frame has a gradient.
        (turns.sum() + depths.sum() + scene.object_poses.orient.sum()).backward()
        optimizer.step_frames(torch.tensor([frame]))

    step(0)
    assert torch.all(turns[0] == -turns[0].abs()) and torch.all(turns[0] != 0)
    assert torch.all(turns[others] == 0) and torch.all(scene.object_poses.orient[others] == 0)
    assert torch.all(optimizer.state[turns]["exp_avg"][others] == 0)
    # Depths go on with every step.
    assert torch.all(depths != 0)

    first, moments = turns[0].clone(), optimizer.state[turns]["exp_avg_sq"][0].clone()
    step(1)
    assert torch.equal(turns[0], first) and torch.equal(optimizer.state[turns]["exp_avg_sq"][0], moments)
    assert torch.all(turns[1] != 0)


def test_a_step_on_all_frames_is_plain_adam(both_hands: dict[Side, HandModel]) -> None:
    poses = []
    for plain in (True, False):
        scene = cube_scene(both_hands)
        optimizer = make_optimizer(scene, {"hand.pose": 0.1}, BETAS, frame_moments=True)
        pose = scene.hand_poses["right"].pose
        torchs = torch.optim.Adam(optimizer.parameters(), lr=0.1, betas=BETAS, eps=1e-15, fused=True)
        for _ in range(3):
            optimizer.zero_grad()
            (pose - 1.0).square().sum().backward()
            torchs.step() if plain else optimizer.step_frames(torch.arange(scene.n_frames))
        poses.append(pose.detach())
    assert torch.equal(*poses) and torch.all(poses[0] != 0)


def test_moments_go_on_elsewhere_as_copies() -> None:
    def descend(parameter: torch.nn.Parameter, optimizer: FrameAdam) -> None:
        optimizer.zero_grad()
        (parameter - 1.0).square().sum().backward()
        optimizer.step()

    one, idle = torch.nn.Parameter(torch.zeros(3)), torch.nn.Parameter(torch.zeros(2))
    first = FrameAdam([{"params": [idle], "lr": 1.0}, {"params": [one], "lr": 0.1}])
    descend(one, first)
    other = torch.nn.Parameter(one.detach().clone())
    second = FrameAdam([{"params": [idle], "lr": 1.0}, {"params": [other], "lr": 0.1}])
    second.set_moments(first.moments())
    assert list(second.moments()) == [1]
    descend(other, second)
    assert float(first.moments()[1]["step"]) == 1.0
    descend(one, first)
    assert torch.equal(one, other)


def test_the_optimiser_needs_no_compiler() -> None:
    code = (
        "import sys, torch; from bigs.train.loop.adam import FrameAdam; "
        "p = torch.nn.Parameter(torch.ones(2)); o = FrameAdam([{'params': [p], 'lr': 0.1}]); "
        "p.sum().backward(); o.step(); o.zero_grad(); o.set_moments(o.moments()); "
        "sys.exit('torch._dynamo' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

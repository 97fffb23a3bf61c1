"""Trainable groups: together they are the whole scene, each parameter in exactly one."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import pytest
import torch
from toy_scenes import cube_scene

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.models.scene import Scene
from bigs.train.build import build_scene
from bigs.train.optim import FIELD_GROUPS, GROUPS, group_parameters, make_optimizer, set_cosine_rates
from bigs.train.presets import SMOKE
from bigs.types import Side


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
    with pytest.raises(InputError, match=r"expected groups out of .*hand\.ray.*found 'hand\.rays'"):
        make_optimizer(cube_scene(both_hands), {"hand.rays": 0.1})


def test_only_listed_groups_require_gradients(both_hands: dict[Side, HandModel]) -> None:
    scene = cube_scene(both_hands)
    make_optimizer(scene, {"hand.ray": 0.1, "object.scale": 0.2, "scene.light": 0.3})
    trainable = {name for name, p in scene.named_parameters() if p.requires_grad}
    assert trainable == {
        "hand_poses.right.position.ray",
        "hand_poses.left.position.ray",
        "object_poses.log_scale",
        "lighting.clip",
    }


def test_rates_fall_along_a_cosine(both_hands: dict[Side, HandModel]) -> None:
    optimizer = make_optimizer(cube_scene(both_hands), {"hand.ray": 0.5, "hand.depth": 2.0})
    for progress, share in ((0.0, 1.0), (0.5, 0.55), (0.25, 0.1 + 0.45 * (1 + math.sqrt(0.5))), (1.0, 0.1)):
        set_cosine_rates(optimizer, progress, 0.1)
        rates = {group["name"]: group["lr"] for group in optimizer.param_groups}
        assert rates == pytest.approx({"hand.ray": 0.5 * share, "hand.depth": 2.0 * share})

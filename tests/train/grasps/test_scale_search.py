"""The object's size from contact, on a cube whose size is known."""

from __future__ import annotations

import pytest
import torch
from toy_scenes import CENTER, HALF, cube_scene

from bigs.hand import HandModel
from bigs.train.grasps.scale_search import _costs, _of_choices, agreed, lowest, search_object_scale
from bigs.train.plan.config import ScaleSearchStage
from bigs.types import Side

STAGE = ScaleSearchStage()
GRID_STEP = 2 * STAGE.span / (STAGE.candidates - 1)


def touching(frames: int = 3, value: float = 1.0) -> dict[Side, torch.Tensor]:
    return {"right": torch.full((frames,), value), "left": torch.full((frames,), value)}


@pytest.mark.parametrize("size", [0.9, 0.97, 1.0, 1.06, 1.12])
def test_recovers_a_known_size(both_hands: dict[Side, HandModel], size: float) -> None:
    scene = cube_scene(both_hands, size)
    factor, spread, factors, costs = search_object_scale(scene, STAGE, touching())
    assert 0.0 <= spread < STAGE.span
    assert abs(factor - 1 / size) <= GRID_STEP
    assert len(factors) == len(costs) == STAGE.candidates
    assert scene.object_poses.log_scale.exp().item() == pytest.approx(factor)
    assert costs.min() < 0.5 * costs.max()
    pose = scene.at(torch.arange(3)).object
    # Size and depth change together, so the cube is where it truly is, too.
    torch.testing.assert_close(pose.centers[0], torch.tensor(CENTER), atol=CENTER[2] * GRID_STEP, rtol=0)
    corner = scene.at(torch.arange(3)).object_points(scene.object_surface.verts) - pose.centers[:, None]
    assert corner.abs().max().item() == pytest.approx(HALF, abs=HALF * 1.1 * GRID_STEP)


def test_leaves_the_projection_alone(both_hands: dict[Side, HandModel]) -> None:
    scene = cube_scene(both_hands, 0.9)
    frames = torch.arange(3)
    with torch.no_grad():
        before = scene.at(frames).object_points(scene.object_surface.verts)
        search_object_scale(scene, STAGE, touching())
        after = scene.at(frames).object_points(scene.object_surface.verts)
    assert not torch.allclose(before, after, atol=1e-3)
    torch.testing.assert_close(before[..., :2] / before[..., 2:], after[..., :2] / after[..., 2:])


def test_continues_from_the_present_scale(both_hands: dict[Side, HandModel]) -> None:
    """The factors are relative: a second search finds nothing left to change."""
    scene = cube_scene(both_hands, 0.9)
    search_object_scale(scene, STAGE, touching())
    factor, *_ = search_object_scale(scene, STAGE, touching())
    assert abs(factor - 1.0) <= GRID_STEP


def test_without_touch_nothing_changes(both_hands: dict[Side, HandModel]) -> None:
    scene = cube_scene(both_hands, 0.9)
    factor, *_ = search_object_scale(scene, STAGE, touching(value=0.0))
    assert factor == 1.0
    assert scene.object_poses.log_scale.item() == 0.0


def test_only_touching_frames_count(both_hands: dict[Side, HandModel]) -> None:
    scene = cube_scene(both_hands, 0.95)
    with torch.no_grad():  # in frame 2 both hands are far away
        for poses in scene.hand_poses.values():
            poses.position.log_depth[2] = 0.3
    together = {side: torch.tensor([1.0, 1.0, 0.0]) for side in ("right", "left")}
    factor, *_ = search_object_scale(scene, STAGE, together)
    assert abs(factor - 1 / 0.95) <= GRID_STEP


def test_grasps_that_disagree_make_the_size_uncertain(both_hands: dict[Side, HandModel]) -> None:
    agreed = search_object_scale(cube_scene(both_hands, 0.95), STAGE, touching())
    scene = cube_scene(both_hands, 0.95)
    with torch.no_grad():  # the left hand's depth says that the cube is larger
        scene.hand_poses["left"].position.log_depth += 0.04
    disputed = search_object_scale(scene, STAGE, touching())
    assert disputed.spread > 3.0 * agreed.spread
    assert disputed.text() == f"{disputed.factor:.3f} ± {disputed.spread:.3f}"
    # What is less sure counts less.
    sure = {"right": torch.ones(3), "left": torch.full((3,), 0.0)}
    one_sided = search_object_scale(cube_scene(both_hands, 0.95), STAGE, sure)
    assert abs(one_sided.factor - 1 / 0.95) <= GRID_STEP
    assert one_sided.text() == f"{one_sided.factor:.3f}", "one piece of evidence has no spread"


def test_many_choices_err_less_than_one_where_grasps_scatter() -> None:
    """Where each grasp is off by 4 %, one of them decides which of the cost's minima is the least."""
    generator = torch.Generator().manual_seed(3)
    factors = torch.linspace(1.0 - STAGE.span, 1.0 + STAGE.span, STAGE.candidates)
    of_frame = torch.arange(24) // 4
    pieces = [("right", of_frame == g) for g in range(6)]
    once, chosen = [], []
    for _ in range(24):
        own = 1.0 + 0.04 * torch.randn(6, generator=generator)
        away = (factors[:, None] - own[of_frame]).abs()
        gaps, sure = {"right": away / (away + 0.01)}, {"right": torch.ones(24)}
        once.append(lowest(factors, _costs(gaps, sure)) - 1.0)
        factor, spread = agreed(_of_choices(factors, gaps, sure, pieces, torch.zeros(len(factors))))
        chosen.append(factor - 1.0)
        assert 0.0 < spread < 0.06
    assert torch.tensor(chosen).square().mean() < 0.7 * torch.tensor(once).square().mean()

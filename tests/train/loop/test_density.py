"""Who is cloned, split and pruned, on Gaussians made by hand; and when."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bigs.geometry.rotations import axis_angle_to_matrix, matrix_to_quat
from bigs.models.canonical import CanonicalObject
from bigs.models.object_splats import Anchors
from bigs.train.loop.density import Pull, densified, fates, object_radius
from bigs.train.plan.densify_config import DensifyConfig

# Thresholds in round numbers, on an object of radius 1.
CONFIG = DensifyConfig(threshold=1.0, small=0.01, large=0.1, least_opacity=0.005, floor=1, ceiling=100)


def gaussians(longest: list[float], opacities: list[float] | None = None) -> CanonicalObject:
    """Gaussians in a row; a third as thick as they are long."""
    count = len(longest)
    scales = torch.tensor(longest)[:, None] * torch.tensor([1 / 3, 1.0, 1 / 3])
    return CanonicalObject(
        torch.arange(3.0 * count).reshape(count, 3),
        torch.zeros(count, 3),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales,
        torch.tensor(opacities or [0.9] * count),
        torch.rand(count, 3, generator=torch.Generator().manual_seed(0)),
        torch.tensor([0.0, 0.0, 1.0]).repeat(count, 1),
        torch.eye(count, 16),
    )


def names(longest: list[float], pull: list[float], opacities: list[float] | None = None, **config) -> str:
    """One letter for each: cloned, split, pruned or left."""
    fate = fates(gaussians(longest, opacities), torch.tensor(pull), 1.0, replace(CONFIG, **config))
    marks = torch.stack(fate)
    assert (marks.sum(0) <= 1).all()
    return "".join("CSP"[int(column.int().argmax())] if column.any() else "-" for column in marks.T)


def test_small_ones_are_cloned_large_ones_split_and_calm_ones_left() -> None:
    assert names([0.009, 0.011, 0.009, 0.011], [1.1, 1.1, 0.9, 0.9]) == "CS--"


def test_the_longest_axis_counts_as_a_share_of_the_radius() -> None:
    whole, pull = gaussians([0.009, 0.011]), torch.full((2,), 2.0)
    assert fates(whole, pull, 1.0, CONFIG).split.tolist() == [False, True]
    assert fates(whole, pull, 0.5, CONFIG).split.tolist() == [True, True]


def test_transparent_ones_go_whatever_pulls_at_them() -> None:
    assert names([0.005] * 4, [0.0, 9.0, 0.0, 9.0], [0.004, 0.004, 0.006, 0.006]) == "PP-C"


def test_far_too_large_ones_go_unless_they_are_split() -> None:
    assert names([0.11, 0.11, 0.09], [0.0, 2.0, 0.0]) == "PS-"


def test_the_ceiling_leaves_room_for_the_strongest_pull() -> None:
    pulls = [2.0, 5.0, 3.0, 4.0]
    assert names([0.005] * 4, pulls, ceiling=6) == "-C-C"
    assert names([0.005] * 4, pulls, ceiling=4) == "----"
    assert names([0.005] * 4, pulls, ceiling=2) == "----"
    assert names([0.02] * 4, pulls, ceiling=7) == "-SSS"  # two in the place of one is one more


def test_the_floor_spares_the_more_opaque_and_the_shorter() -> None:
    opacities = [0.001, 0.003, 0.9, 0.9, 0.9]
    lengths = [0.005, 0.005, 0.2, 0.3, 0.005]
    calm = [0.0] * 5
    assert names(lengths, calm, opacities) == "PPPP-"
    assert names(lengths, calm, opacities, floor=2) == "PP-P-"
    assert names(lengths, calm, opacities, floor=4) == "P----"
    assert names(lengths, calm, opacities, floor=6) == "-----"
    # Who is added makes room for one more to go.
    assert names(lengths, [0.0, 0.0, 0.0, 0.0, 2.0], opacities, floor=4) == "PP--C"


def anchors_of(whole: CanonicalObject) -> Anchors:
    count = len(whole.means)
    generator = torch.Generator().manual_seed(1)
    return Anchors(
        whole.means - 0.01,  # the field has moved them
        whole.normals,
        whole.quats,
        whole.scales.log() - 0.3,  # and lengthened them
        torch.randn(count, 3, generator=generator),
        whole.weights,
    )


def pull_at(which: list[int], count: int, drift: Tensor) -> Pull:
    """Twice the threshold at some Gaussians, seen in four views."""
    total = torch.zeros(count)
    total[which] = 8.0
    return Pull(total, torch.full((count,), 4.0), drift.expand(count, 3))


def grown(anchors: Anchors, whole: CanonicalObject, pull: Pull, config: DensifyConfig = CONFIG) -> Anchors:
    return densified(anchors, whole, pull, config)


def test_a_clone_stands_one_deviation_downhill_and_is_else_the_same() -> None:
    # The second axis, three times as long as the others, lies along x after this turn.
    turn = axis_angle_to_matrix(torch.tensor([0.0, 0.0, math.pi / 2]))
    whole = gaussians([0.03] * 3)._replace(quats=matrix_to_quat(turn).expand(3, 4))
    anchors = anchors_of(whole)
    config = replace(CONFIG, small=0.05)
    for drift, aside in (([7.0, 0.0, 0.0], [-0.03, 0.0, 0.0]), ([0.0, -2.0, 0.0], [0.0, 0.01, 0.0])):
        made = grown(anchors, whole, pull_at([1], 3, torch.tensor(drift)), config)
        for before, after in zip(anchors, made, strict=True):
            assert torch.equal(after[:3], before)  # nobody else moves
            assert len(after) == 4
        expected = anchors.base_points[1] + torch.tensor(aside)
        torch.testing.assert_close(made.base_points[3], expected, atol=1e-6, rtol=0)
        for before, after in zip(anchors[1:], made[1:], strict=True):
            assert torch.equal(after[3], before[1])


def test_without_a_direction_a_clone_is_still_finite() -> None:
    whole = gaussians([0.005, 0.005])
    made = grown(anchors_of(whole), whole, pull_at([0], 2, torch.zeros(3)))
    assert len(made.base_points) == 3 and made.base_points.isfinite().all()


def test_two_halves_have_together_the_covariance_of_the_whole() -> None:
    turn = axis_angle_to_matrix(torch.tensor([0.4, -0.7, 0.2]))
    whole = gaussians([0.03] * 3)._replace(quats=matrix_to_quat(turn).expand(3, 4))
    anchors = anchors_of(whole)
    made = grown(anchors, whole, pull_at([1], 3, torch.ones(3)), replace(CONFIG, small=1e-4))
    assert torch.equal(made.base_points[:2], anchors.base_points[[0, 2]])
    one, other = made.base_points[2:] - anchors.base_points[1]
    torch.testing.assert_close(one, -other, atol=1e-6, rtol=0)
    # Along the second axis, the longest, they are shorter; else they are the whole's own.
    shorter = torch.tensor([0.0, math.log(1.6), 0.0])
    torch.testing.assert_close(
        anchors.base_log_scales[[1, 1]] - made.base_log_scales[2:], shorter.expand(2, 3)
    )
    covariance = turn @ torch.diag((whole.scales[0] * (-shorter).exp()).square()) @ turn.T
    expected = turn @ torch.diag(whole.scales[0].square()) @ turn.T
    torch.testing.assert_close(covariance + torch.outer(one, one), expected, atol=1e-7, rtol=1e-3)
    for before, after in zip((*anchors[1:3], *anchors[4:]), (*made[1:3], *made[4:]), strict=True):
        assert torch.equal(after[2:], before[[1, 1]])


def test_isotropic_halves_stay_balls() -> None:
    whole = gaussians([0.03])._replace(scales=torch.full((1, 3), 0.03))
    anchors = anchors_of(whole)
    made = densified(
        anchors, whole, pull_at([0], 1, torch.ones(3)), replace(CONFIG, large=10.0), isotropic=True
    )
    torch.testing.assert_close(made.base_log_scales, anchors.base_log_scales.expand(2, 3) - math.log(1.6))


def test_what_is_pruned_is_gone() -> None:
    whole = gaussians([0.005, 0.02, 0.005, 0.005], [0.9, 0.9, 0.001, 0.9])
    anchors, pull = anchors_of(whole), pull_at([1, 3], 4, torch.ones(3))
    made = grown(anchors, whole, pull, replace(CONFIG, small=0.01 / object_radius(anchors.base_points)))
    assert len(made.base_points) == 2 + 1 + 2  # left, a clone, two halves
    assert torch.equal(made.base_points[:2], anchors.base_points[[0, 3]])
    assert torch.equal(made.color_logits[2:], anchors.color_logits[[3, 1, 1]])


def test_pull_is_a_mean_over_the_views_that_show_a_gaussian() -> None:
    pull = Pull.none(3)
    first = torch.tensor([[[3.0, 4.0], [1.0, 0.0], [9.0, 9.0]], [[0.0, 1.0], [0.0, 0.0], [9.0, 9.0]]])
    shown = torch.tensor([[True, True, False], [True, False, False]])
    more = pull.plus(first, shown, torch.ones(3, 3)).plus(first[:1], shown[:1], torch.ones(3, 3))
    torch.testing.assert_close(more.mean, torch.tensor([11.0 / 3.0, 1.0, 0.0]))
    assert torch.equal(more.drift, torch.full((3, 3), 2.0))
    assert not any(values.any() for values in pull)  # what is kept to go back to does not change


def test_the_radius_is_that_of_the_farthest_point() -> None:
    ball = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    assert object_radius(5.0 + 0.04 * ball) == pytest.approx(0.04, rel=0.02)


def test_times_are_the_released_codes_and_shrink_with_the_stage() -> None:
    config = DensifyConfig()
    times = [step for step in range(30_001) if config.is_due(30_000, step)]
    assert times == list(range(3600, 14_401, 600))
    watched = [step for step in range(30_000) if config.watches(30_000, step)]
    assert watched == list(range(3000, 14_400))
    assert [step for step in range(301) if config.is_due(300, step)] == list(range(36, 145, 6))


@pytest.mark.parametrize("steps", [*range(1, 60), 777])
def test_there_is_something_to_judge_by_whenever_it_is_time(steps: int) -> None:
    for config in (DensifyConfig(), DensifyConfig(first=0.0, last=1.0, every=0.3)):
        due = [step for step in range(steps + 1) if config.is_due(steps, step)]
        assert all(config.watches(steps, step - 1) for step in due)
        assert steps not in due and 0 not in due
        # Nothing is gathered that nobody will look at.
        last = max(due, default=0)
        assert not any(config.watches(steps, step) for step in range(last, steps))

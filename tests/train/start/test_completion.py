"""Completion by symmetry of clips that show one side of their object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from limited_view import limited_view

from bigs.data.base import Clip
from bigs.geometry.distance import DistanceField
from bigs.geometry.support import seen_samples
from bigs.geometry.surface import DistanceGrid, convex_distance
from bigs.geometry.symmetry import Symmetry
from bigs.hand import HandModel
from bigs.metrics.align import similarity_icp
from bigs.metrics.shape import ShapeScore
from bigs.train.plan.presets import SMOKE
from bigs.train.plan.start_config import CompletionConfig, InitialConfig
from bigs.train.start import completion
from bigs.train.start.build import build_scene
from bigs.train.start.completion import Completion, complete
from bigs.train.start.initial import ObjectStart, object_in_camera, smooth_object
from bigs.train.start.visual_hull import ClosedSurface, ObjectHull, find_object_hull
from bigs.types import HandObjectTrajectory, Side

INITIAL = InitialConfig(surface_resolution=56)


@pytest.fixture(scope="module")
def one_side(whole_bottle: tuple[Clip, HandObjectTrajectory]) -> tuple[Clip, ObjectHull, ObjectStart]:
    clip = limited_view(*whole_bottle, range(8))
    start = smooth_object(object_in_camera(clip, INITIAL), 2.0)
    return clip, find_object_hull(clip, nothing_hides(clip), start, INITIAL), start


def nothing_hides(clip: Clip) -> np.ndarray:
    return np.zeros((len(clip), clip.height, clip.width), dtype=bool)


def score(surface: ClosedSurface, truth: HandObjectTrajectory) -> ShapeScore:
    verts, faces = surface.mesh()
    return similarity_icp(verts, truth.object_verts[0], faces, truth.object_faces).score


@pytest.mark.slow
def test_the_unseen_side_comes_nearer_to_the_truth(
    one_side: tuple[Clip, ObjectHull, ObjectStart], whole_bottle: tuple[Clip, HandObjectTrajectory]
) -> None:
    _, hull, start = one_side
    found = complete(hull, start, INITIAL, CompletionConfig())
    assert found.seen < 0.7
    assert found.symmetries and len(found.points) == len(found.colors) > 100
    before = score(hull.closed(INITIAL, hull.points, hull.normals), whole_bottle[1])
    after = score(found.surface, whole_bottle[1])
    assert after.chamfer.squared < 0.8 * before.chamfer.squared
    assert after.f5 > before.f5 and after.f10 >= before.f10


def test_hands_meet_what_a_symmetry_makes_of_the_unseen_side(
    one_side: tuple[Clip, ObjectHull, ObjectStart], both_hands: dict[Side, HandModel]
) -> None:
    clip, hull, start = one_side
    found = complete(hull, start, INITIAL, CompletionConfig())
    plan = (clip, nothing_hides(clip), both_hands, INITIAL, SMOKE.hand, SMOKE.object, False)
    built, plain = build_scene(*plan, CompletionConfig()), build_scene(*plan)
    assert len(built.symmetries) == len(found.symmetries) > 0 and not plain.symmetries
    solid = built.scene.object_distance.values
    assert torch.equal(solid, DistanceField(found.surface.grid).values)
    assert not torch.equal(solid, plain.scene.object_distance.values)
    # The mesh waits for the poses that the run finds.
    assert torch.equal(built.scene.object_surface.verts, plain.scene.object_surface.verts)


def test_the_far_side_is_not_sought_beyond_what_the_symmetry_carried(
    one_side: tuple[Clip, ObjectHull, ObjectStart],
) -> None:
    _, hull, start = one_side
    found = complete(hull, start, INITIAL, CompletionConfig())
    inside = found.surface.grid.points()[found.surface.grid.values.ravel() < 0.0]
    beyond = convex_distance(inside, np.concatenate([hull.points, found.points]))
    assert beyond.max() <= INITIAL.surface_margin + 0.5 * found.surface.grid.spacing


def test_symmetries_found_earlier_count_if_there_are_none_now(
    one_side: tuple[Clip, ObjectHull, ObjectStart],
) -> None:
    _, hull, start = one_side
    base = CompletionConfig()
    found = complete(hull, start, INITIAL, base)
    strict = replace(base, symmetry=replace(base.symmetry, least_support=0.999))
    again = complete(hull, start, INITIAL, strict, found.symmetries)
    assert again.symmetries == found.symmetries
    np.testing.assert_array_equal(again.surface.grid.values, found.surface.grid.values)


def test_symmetries_found_earlier_are_candidates(
    one_side: tuple[Clip, ObjectHull, ObjectStart], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, hull, start = one_side
    plane = Symmetry("plane", np.zeros(3), np.array([1.0, 0.0, 0.0]))
    asked: list[Sequence[Symmetry]] = []

    def search(*args: object) -> list[Symmetry]:
        asked.append(args[3])  # type: ignore[arg-type]
        return []

    monkeypatch.setattr(completion, "find_symmetries", search)
    assert complete(hull, start, INITIAL, CompletionConfig(), [plane]).symmetries == [plane]
    assert asked == [[plane]]


def test_less_counts_as_seen_the_more_frames_must_show_it(
    one_side: tuple[Clip, ObjectHull, ObjectStart],
) -> None:
    _, hull, _ = one_side
    surface = hull.closed(INITIAL, hull.points, hull.normals).mesh()
    shares = [seen_samples(hull.views, *surface, frames, 0.006).seen.mean() for frames in (1, 3, 12)]
    assert shares[0] > shares[1] > shares[2] > 0.0
    assert seen_samples(hull.views, *surface, 3, 0.0).seen.mean() < shares[1]


def test_weak_evidence_changes_nothing(one_side: tuple[Clip, ObjectHull, ObjectStart]) -> None:
    _, hull, start = one_side
    base = CompletionConfig()
    strict = replace(base, symmetry=replace(base.symmetry, least_support=0.999))
    found = complete(hull, start, INITIAL, strict)
    plain = hull.closed(INITIAL, hull.points, hull.normals)
    assert "no strong evidence" in str(found)
    np.testing.assert_array_equal(found.surface.grid.values, plain.grid.values)


def test_an_object_that_was_seen_is_left(one_side: tuple[Clip, ObjectHull, ObjectStart]) -> None:
    _, hull, start = one_side
    found = complete(hull, start, INITIAL, CompletionConfig(enough=0.05))
    assert not found.symmetries and "of the object's surface was seen" in str(found)


def test_the_description_counts_kinds() -> None:
    from bigs.geometry.symmetry import Symmetry

    plane = Symmetry("plane", np.zeros(3), np.eye(3)[0])
    axis = Symmetry("axis", np.zeros(3), np.eye(3)[0])
    surface = ClosedSurface(DistanceGrid(np.zeros((2, 2, 2)), np.zeros(3), 1.0), np.zeros((7, 3)))
    found = Completion(surface, 0.5, [plane, axis, plane], np.zeros((7, 3)), np.zeros((7, 3)))
    text = "2 mirror planes, 1 axis of revolution found, 7 points added where nothing was seen"
    assert str(found) == text


def test_the_command_line_names_the_kinds(tmp_path: Path) -> None:
    from typing import get_args

    from bigs.cli.runs import Prior
    from bigs.train.plan.config import PriorKind

    assert set(get_args(Prior)) == {"auto", *get_args(PriorKind)}

"""What cropped pictures spare: nothing where they are whole, and else all that is outside."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from toy_stages import ALONE, TOGETHER

from bigs.fused.outline import covered_shares
from bigs.models.scene import Scene
from bigs.raster import rasterization
from bigs.train.loop.outside import seconds_outside
from bigs.train.loop.run_stage import StageProgress, run_stage
from bigs.train.loop.step import Evidence, Selection, Step
from bigs.train.loop.terms import IMAGE_TERMS, TERMS
from bigs.train.plan.config import OptimizeStage
from bigs.types import Entity


def upper(evidence: Evidence, rows: int) -> Evidence:
    """The upper rows of the targets: the rest of the picture is outside."""
    whole = evidence.targets
    cut = replace(
        whole,
        images=whole.images[:, :rows],
        shares={entity: share[:, :rows] for entity, share in whole.shares.items()},
        unknown=whole.unknown[:, :rows],
        height=rows,
    )
    return replace(evidence, targets=cut)


def finished_step(scene: Scene, evidence: Evidence, kind: str, entities: tuple[Entity, ...]) -> Step:
    step = Step(scene, evidence, scene.canonical(entities), Selection(torch.tensor([0, 2]), entities))
    terms = (IMAGE_TERMS[kind]["image"], TERMS["silhouette"])
    sum(term(step) for term in terms).backward()
    return step


@pytest.mark.parametrize(
    ("kind", "channels"), [("single-subject", [3, 3, 3, 0, 0]), ("interacting-subjects", [6, 0, 0])]
)
def test_every_picture_counts_with_what_it_leaves_out(
    scene: Scene, evidence: Evidence, kind: str, channels: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    step = finished_step(scene, upper(evidence, 18), kind, scene.entities)
    drawn = []
    clock = SimpleNamespace(now=0.0)

    def watched(means: torch.Tensor, *arguments: object, **options: object) -> object:
        _, _, _, colors, _, _, width, height = arguments
        drawn.append((*means.shape[:2], colors.shape[-1], width, height))
        clock.now += height
        return rasterization(means, *arguments, **options)

    def watched_outline(points: torch.Tensor, *arguments: int) -> torch.Tensor:
        drawn.append((len(points), points.shape[1], 0, *arguments[-2:]))
        clock.now += arguments[-1]
        return covered_shares(points, *arguments)

    monkeypatch.setattr("bigs.train.loop.step.rasterization", watched)
    monkeypatch.setattr("bigs.train.loop.outside.covered_shares", watched_outline)
    monkeypatch.setattr("bigs.train.loop.outside.time", SimpleNamespace(perf_counter=lambda: clock.now))
    before = {name: p.grad.clone() for name, p in scene.named_parameters() if p.grad is not None}
    # A row takes a second here.
    assert seconds_outside(step) == pytest.approx(12 * len(channels))
    # Each twice, of which the shorter counts; nothing to draw; all 30 rows, of which 12 are not looked at.
    assert drawn[::2] == drawn[1::2] == [(2, 0, count, 40, 30) for count in channels]
    # Nothing reaches the scene.
    assert all(torch.equal(p.grad, before[name]) for name, p in scene.named_parameters() if name in before)


def test_whole_pictures_spare_nothing(scene: Scene, evidence: Evidence) -> None:
    assert seconds_outside(finished_step(scene, evidence, "single-subject", scene.entities)) == 0.0


@pytest.mark.parametrize("stage", [ALONE, TOGETHER], ids=lambda stage: stage.step)
def test_every_step_of_a_stage_spares_the_same(
    scene: Scene, evidence: Evidence, stage: OptimizeStage
) -> None:
    told: list[StageProgress] = []
    stage = replace(stage, steps=3)
    run_stage(scene, stage, upper(evidence, 18), 0, after_step=lambda progress, state: told.append(progress))
    assert len(told) == 3
    assert told[0].pixels_spared > 0.0
    assert len({progress.pixels_spared for progress in told}) == 1

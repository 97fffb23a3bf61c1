"""A completed object is covered as its new surface is."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from bigs.models.occlusion import measure_occlusion
from bigs.models.scene import ObjectSurface, Scene
from bigs.train.plan.config import CompletionStage
from bigs.train.plan.presets import SMOKE
from bigs.train.unseen import stages
from bigs.train.unseen.symmetry_stage import StageOutcome


@pytest.mark.parametrize("measured", [False, True])
def test_completion_measures_occlusion_where_it_was_measured(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, measured: bool
) -> None:
    if measured:
        measure_occlusion(scene)
    before = scene.lighting.occlusion["object"].places.clone()

    def completed(scene: Scene, *others: object) -> StageOutcome:
        surface = scene.object_surface
        scene.replace_surface(ObjectSurface(1.5 * surface.verts, surface.faces))
        return StageOutcome(None, {})

    monkeypatch.setattr(stages, "complete_scene", completed)
    sources = SimpleNamespace(clip=None, unknown=None, evidence=lambda stage: None)
    stages.run_completion(scene, CompletionStage(), sources, SMOKE, ())
    after = scene.lighting.occlusion["object"].places
    if measured:
        assert after.norm(dim=1).max() > 1.3 * before.norm(dim=1).max()
    else:
        assert torch.equal(after, before) and not scene.lighting.measured

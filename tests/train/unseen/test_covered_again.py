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


def run_completion(scene: Scene) -> None:
    sources = SimpleNamespace(clip=None, unknown=None, evidence=lambda stage: None)
    stages.run_completion(scene, CompletionStage(), sources, SMOKE, ())


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
    run_completion(scene)
    after = scene.lighting.occlusion["object"].places
    if measured:
        assert after.norm(dim=1).max() > 1.3 * before.norm(dim=1).max()
    else:
        assert torch.equal(after, before) and not scene.lighting.measured


def test_colors_keep_the_occlusion_they_were_learned_with(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where nothing is completed, frames look as they did in the last step, though poses have moved since."""
    measure_occlusion(scene)
    before = scene.lighting.occlusion["object"].at(scene.object_splats.base_points).clone()
    with torch.no_grad():
        scene.hand_poses["right"].position.log_depth += 0.1
    monkeypatch.setattr(stages, "complete_scene", lambda *given: StageOutcome("nothing to do", {}))
    run_completion(scene)
    assert torch.equal(scene.lighting.occlusion["object"].at(scene.object_splats.base_points), before)

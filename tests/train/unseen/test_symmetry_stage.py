"""Completion by symmetry as a stage: poses and what shows stay, the rest is replaced, damage is undone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from limited_view import limited_view

from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.metrics.align import similarity_icp
from bigs.metrics.shape import ShapeScore
from bigs.models.scene import Scene
from bigs.train.fit import fit
from bigs.train.fit_report import FitReport
from bigs.train.loop.evidence import EvidenceSource
from bigs.train.loop.target_source import TargetSource
from bigs.train.plan.config import CompletionStage, PriorConfig, RunConfig, SplitStage
from bigs.train.plan.presets import SMOKE
from bigs.train.plan.start_config import CompletionConfig, InitialConfig
from bigs.train.resolve import resolve
from bigs.train.unseen.symmetry_stage import blended_colors
from bigs.train.unseen.visibility import image_error, weights_in_pictures
from bigs.types import HandObjectTrajectory, Side

PLAN = replace(
    SMOKE,
    prior=PriorConfig("symmetry"),
    initial=InitialConfig(surface_resolution=56),
    object=replace(SMOKE.object, n_gaussians=1500),
    stages=(SplitStage(parts=1), CompletionStage()),
)


@pytest.fixture(scope="module")
def bottle(whole_bottle: tuple[Clip, HandObjectTrajectory]) -> tuple[Clip, HandObjectTrajectory]:
    """A third of a turn of a bottle, and the truth."""
    return limited_view(*whole_bottle, range(12)), whole_bottle[1]


@pytest.fixture(scope="module")
def plain(
    bottle: tuple[Clip, HandObjectTrajectory], both_hands: dict[Side, HandModel]
) -> tuple[Scene, FitReport]:
    return fit(bottle[0], both_hands, resolve(replace(PLAN, prior=PriorConfig("off"))).config)


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Those of `completed`."""
    return tmp_path_factory.mktemp("checkpoints")


@pytest.fixture(scope="module")
def completed(
    bottle: tuple[Clip, HandObjectTrajectory], both_hands: dict[Side, HandModel], checkpoints: Path
) -> tuple[Scene, FitReport]:
    return fit(bottle[0], both_hands, PLAN, checkpoints=checkpoints)


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor], names: tuple[str, ...]) -> bool:
    """Whether all tensors whose names begin so are the same bits."""
    chosen = [name for name in a if name.startswith(names)]
    return bool(chosen) and all(torch.equal(a[name], b[name]) for name in chosen)


def shape(scene: Scene, truth: HandObjectTrajectory) -> ShapeScore:
    surface = scene.object_surface
    return similarity_icp(
        surface.verts.numpy(), truth.object_verts[0], surface.faces.numpy(), truth.object_faces
    ).score


def test_off_there_is_no_such_stage(plain: tuple[Scene, FitReport]) -> None:
    assert CompletionStage().name not in plain[1].seconds
    assert plain[1].skipped == [] and set(plain[1].facts) == {"object mesh"}


def test_the_shape_gains_and_nothing_that_was_seen_changes(
    plain: tuple[Scene, FitReport],
    completed: tuple[Scene, FitReport],
    bottle: tuple[Clip, HandObjectTrajectory],
) -> None:
    before, after = plain[0].state_dict(), completed[0].state_dict()
    assert "found" in completed[1].facts["object completed"]
    assert "%" in completed[1].facts["object seen"] and "object mesh" not in completed[1].facts
    assert same(before, after, ("hand_poses", "object_poses", "betas", "grasps", "hand_splats", "lighting"))
    scores = [shape(scene, bottle[1]) for scene in (plain[0], completed[0])]
    assert scores[1].chamfer.squared < 0.8 * scores[0].chamfer.squared
    assert scores[1].f5 > scores[0].f5 and scores[1].f10 >= scores[0].f10
    # Gaussians: those that show are left to the last bit, in front of the new ones; of the rest none is.
    old, new = plain[0].object_splats, completed[0].object_splats
    left = int((new.base_points[:, None] == old.base_points[None]).all(-1).any(1).sum())
    assert 0.3 * len(old.shift) < left < len(old.shift) < len(new.shift) + len(old.shift) - left
    assert not any(parameter.requires_grad for parameter in completed[0].parameters())


def test_hands_meet_the_surface_that_is_completed_later(
    plain: tuple[Scene, FitReport], completed: tuple[Scene, FitReport]
) -> None:
    """A hull of few directions is deep: what hands hold of an object that hardly turned lies inside it."""
    assert completed[1].facts["object completed"]
    verts = completed[0].object_surface.verts
    off, hull_off = (scene.object_distance(verts).abs().mean() for scene in (completed[0], plain[0]))
    assert off < 1e-3 and hull_off > 1.5 * off


def test_what_is_added_shows_in_no_frame(
    plain: tuple[Scene, FitReport],
    completed: tuple[Scene, FitReport],
    bottle: tuple[Clip, HandObjectTrajectory],
) -> None:
    clip = bottle[0]
    sources = EvidenceSource(
        TargetSource(clip, np.zeros((len(clip), 180, 240), dtype=bool)), completed[0], PLAN, None
    )
    evidence = sources.evidence(replace(SMOKE.stages[0], image_size=240))
    known = plain[0].object_splats.base_points
    new = ~(completed[0].object_splats.base_points[:, None] == known[None]).all(-1).any(1)
    assert int(new.sum()) > 30
    assert float(weights_in_pictures(completed[0], evidence)[new].max()) < 0.05
    everything = torch.arange(len(clip))
    errors = [image_error(scene, evidence, scene.entities, everything) for scene in (plain[0], completed[0])]
    assert errors[1] < 1.005 * errors[0]


def test_a_place_has_the_colour_of_its_gaussians_together(plain: tuple[Scene, FitReport]) -> None:
    """After a thousand steps the nearest alone says little: preset full then missed a bottle's symmetry."""
    whole = plain[0].object_splats()
    noise = 0.3 * torch.randn(whole.colors.shape, generator=torch.Generator().manual_seed(0))
    everyone = np.ones(len(noise), dtype=bool)
    clean = blended_colors(whole, everyone, whole.means.numpy())
    noisy = blended_colors(whole._replace(colors=whole.colors + noise), everyone, whole.means.numpy())
    assert np.abs(noisy - clean).mean() < 0.4 * float(noise.abs().mean())

    one = everyone & (np.arange(len(noise)) == 7)
    assert blended_colors(whole, one, whole.means.numpy()[:3]) == pytest.approx(
        whole.colors[7].numpy()[None].repeat(3, 0)
    )
    # What covers nothing has no say.
    bare = whole._replace(opacities=whole.opacities * torch.as_tensor(~one), colors=whole.colors + noise)
    same_bare = bare._replace(colors=bare.colors + torch.as_tensor(one)[:, None])
    points = whole.means.numpy()[7:8]
    assert np.array_equal(*(blended_colors(w, everyone, points) for w in (bare, same_bare)))


@pytest.mark.parametrize(
    "plan",
    [
        replace(PLAN, prior=PriorConfig("symmetry", completion=CompletionConfig(enough=0.05))),
        replace(PLAN, stages=(SplitStage(parts=1), CompletionStage(most_worsening=-1.0))),
    ],
    ids=["seen", "worse"],
)
def test_where_it_does_not_help_the_scene_is_as_if_it_were_off(
    plan: RunConfig,
    bottle: tuple[Clip, HandObjectTrajectory],
    plain: tuple[Scene, FitReport],
    both_hands: dict[Side, HandModel],
) -> None:
    scene, report = fit(bottle[0], both_hands, plan)
    (why,) = report.skipped
    assert why.startswith("object-completion: ")
    before, after = plain[0].state_dict(), scene.state_dict()
    assert before.keys() == after.keys()
    assert same(before, after, ("",))


def test_what_was_seen_is_told_without_a_hull(
    bottle: tuple[Clip, HandObjectTrajectory],
    completed: tuple[Scene, FitReport],
    both_hands: dict[Side, HandModel],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The surface at hand and the one made anew say the same of what was seen; the first says it sooner."""
    enough = replace(PLAN, prior=PriorConfig("symmetry", completion=CompletionConfig(enough=0.05)))
    made: list[str] = []
    monkeypatch.setattr("bigs.train.unseen.symmetry_stage.find_object_hull", lambda *a: made.append("hull"))
    _, report = fit(bottle[0], both_hands, enough)
    told, remade = (int(facts["object seen"].split("%")[0]) for facts in (report.facts, completed[1].facts))
    assert report.skipped == [f"object-completion: {told}% of the object's surface was seen"]
    assert abs(told - remade) <= 3 and made == []


def test_a_completed_object_comes_back_from_its_checkpoint(
    bottle: tuple[Clip, HandObjectTrajectory],
    completed: tuple[Scene, FitReport],
    both_hands: dict[Side, HandModel],
    checkpoints: Path,
) -> None:
    """Though it has other Gaussians, vertices and faces than the scene that a resumed run begins with."""
    events: list[dict[str, Any]] = []
    scene, report = fit(
        bottle[0], both_hands, PLAN, checkpoints=checkpoints, resume=True, listen=events.append
    )
    assert not any(event["event"] == "stage" for event in events)
    assert same(completed[0].state_dict(), scene.state_dict(), ("",))
    assert report.facts == completed[1].facts

"""The object's Gaussians are split where pictures show what is smaller than they are, and only there."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch
from limited_view import fitted_view
from torch import Tensor

from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.models.object_detail import ObjectDetail
from bigs.models.scene import Scene
from bigs.train.loop.refinement import fewest_holding, over_pixels, refined, unresolved
from bigs.train.loop.step import Evidence, Selection, Step
from bigs.train.plan.config import PriorConfig, RefineStage, SplitStage
from bigs.train.plan.presets import SMOKE
from bigs.types import HandObjectTrajectory, Side

STAGE = RefineStage(image_size=240)
PLAN = replace(
    SMOKE,
    prior=PriorConfig("off"),
    object=replace(SMOKE.object, n_gaussians=600),
    stages=(SplitStage(parts=1),),
)


@pytest.fixture(scope="module")
def made(
    whole_bottle: tuple[Clip, HandObjectTrajectory], both_hands: dict[Side, HandModel]
) -> tuple[Scene, Evidence]:
    return fitted_view(*whole_bottle, range(3), both_hands, PLAN, STAGE)


@torch.no_grad()
def printed(scene: Scene, evidence: Evidence, left: Tensor) -> Evidence:
    """Images as the scene renders them, with a fine print at the left and another tint at the right."""
    frames = torch.arange(scene.n_frames)
    step = Step(scene, evidence, scene.canonical(scene.entities), Selection(frames, scene.entities, False))
    height, width = step.images.shape[1:3]
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    checker = 0.1 * (1.0 - 2.0 * ((rows + columns) % 2))
    change = torch.where(left, checker, 0.1)
    return replace(
        evidence, targets=replace(evidence.targets, images=step.together.colors + change[..., None])
    )


@torch.no_grad()
def columns_of(scene: Scene, evidence: Evidence) -> Tensor:
    """The columns [T, N] in which the object's Gaussians show."""
    means = scene.at(torch.arange(scene.n_frames)).posed({"object": scene.object_splats()}).means
    K = evidence.targets.K
    return K[0, 0] * means[..., 0] / means[..., 2] + K[0, 2]


def test_a_print_is_split_and_a_tint_is_not(made: tuple[Scene, Evidence]) -> None:
    scene, evidence = made
    columns = columns_of(scene, evidence)
    middle = float(columns.median())
    left = torch.arange(evidence.targets.width) < middle
    found = unresolved(scene, printed(scene, evidence, left))
    shows = found.pixels > 0.5
    always_left = shows & (columns.amax(0) < middle - 8.0)
    always_right = shows & (columns.amin(0) > middle + 8.0)
    assert min(always_left.sum(), always_right.sum()) > 20
    per_pixel = found.error / found.pixels.clamp_min(1e-3)
    # A large one may reach over from the other half.
    assert per_pixel[always_left].median() > 50.0 * per_pixel[always_right].quantile(0.95)

    splats = scene.object_splats
    assert isinstance(splats, ObjectDetail)
    freedom = torch.linspace(0.0, 1.0, len(splats.shift))
    finer = refined(scene, splats, STAGE, printed(scene, evidence, left), freedom)
    copies = torch.stack([(finer.freedom == own).sum() for own in freedom])
    assert set(copies.tolist()) == {1, 4}
    assert (copies[always_right] == 1).all()
    assert (copies[always_left & (found.pixels >= 2.0)] == 4).float().mean() > 0.7
    assert (copies[found.pixels < 2.0] == 1).all(), "what is smaller than a pixel stays whole"


def test_transparent_gaussians_are_pruned_but_never_all(made: tuple[Scene, Evidence]) -> None:
    scene, evidence = made
    for faint, kept in ((10, 590), (600, 1)):
        splats = copy.deepcopy(scene.object_splats)
        assert isinstance(splats, ObjectDetail)
        with torch.no_grad():
            splats.opacity_logits[:faint] = torch.linspace(-20.0, -19.0, faint)
        whole = RefineStage(image_size=240, error_share=0.0)
        assert len(refined(scene, splats, whole, evidence, torch.ones(600)).shift) == kept


def test_pixels_add_up_to_what_shows(made: tuple[Scene, Evidence]) -> None:
    """In a clip of one frame what Gaussians answer for adds up to their share of the picture."""
    scene, evidence = made
    canonical = scene.canonical(("object",))
    step = Step(scene, evidence, canonical, Selection(torch.tensor([1]), ("object",), labels=False))
    with torch.no_grad():
        expected = (step.share("object") * step.alone("object").alphas[..., 0]).sum()
    (sums,) = over_pixels(step, step.share("object")[..., None], len(canonical["object"].scales))
    assert sums.shape == (len(canonical["object"].scales), 1) and (sums >= 0.0).all()
    torch.testing.assert_close(sums.sum(), expected, rtol=1e-4, atol=0.0)


def test_the_fewest_that_hold_a_share() -> None:
    error = torch.tensor([1.0, 5.0, 0.0, 3.0, 1.0])
    assert fewest_holding(error, 0.5).tolist() == [False, True, False, False, False]
    assert fewest_holding(error, 0.8).tolist() == [False, True, False, True, False]
    assert fewest_holding(error, 0.85).tolist() == [True, True, False, True, False]
    assert fewest_holding(error, 1.0).tolist() == [True, True, False, True, True]
    assert not fewest_holding(error, 0.0).any()
    assert not fewest_holding(torch.zeros(4), 0.9).any(), "where nothing is wrong nothing is split"

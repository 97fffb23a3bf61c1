"""What a clip shows of Gaussians: what masks hold and faces a camera, nothing of what is covered."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from limited_view import fitted_view, limited_view

from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.models.scene import Scene
from bigs.train.fit import fit
from bigs.train.loop.step import Evidence
from bigs.train.plan.config import PriorConfig, SplitStage
from bigs.train.plan.presets import SMOKE
from bigs.train.unseen.stages import OBSERVED_AT
from bigs.train.unseen.visibility import shown
from bigs.types import HandObjectTrajectory, Side

PLAN = replace(
    SMOKE, prior=PriorConfig("off"), object=replace(SMOKE.object, n_gaussians=600), stages=SMOKE.stages[:1]
)


@pytest.fixture(scope="module")
def posed(
    whole_bottle: tuple[Clip, HandObjectTrajectory], both_hands: dict[Side, HandModel]
) -> tuple[Scene, Evidence]:
    return fitted_view(*whole_bottle, range(6), both_hands, PLAN, OBSERVED_AT)


@pytest.fixture(scope="module")
def half_hidden(whole_bottle: tuple[Clip, HandObjectTrajectory], both_hands: dict[Side, HandModel]) -> Scene:
    clip = limited_view(*whole_bottle, range(6))
    return fit(clip, both_hands, replace(PLAN, stages=(SplitStage(),)))[0]


def masked(evidence: Evidence, share: float) -> Evidence:
    """The hands' masks are the same everywhere."""
    shares = {
        entity: values if entity == "object" else torch.full_like(values, share)
        for entity, values in evidence.targets.shares.items()
    }
    return replace(evidence, targets=replace(evidence.targets, shares=shares))


def test_masks_say_what_shows(posed: tuple[Scene, Evidence]) -> None:
    scene, evidence = posed
    found = shown(scene, evidence)
    everything, nothing = (shown(scene, masked(evidence, share)) for share in (1.0, 0.0))
    assert set(found) == {*scene.hand_splats, "object"}
    for side, hand in scene.hand_splats.items():
        values = found[side]
        assert len(values) == len(hand().points)
        assert ((values >= 0.0) & (values <= everything[side] + 1e-6)).all()
        assert everything[side].max() > 0.9 and not nothing[side].any()
        # Where the estimates are about right, most of a hand lies in its mask.
        assert values.sum() > 0.5 * everything[side].sum()


def test_half_a_mask_counts_a_quarter(posed: tuple[Scene, Evidence]) -> None:
    scene, evidence = posed
    whole, half = (shown(scene, masked(evidence, share)) for share in (1.0, 0.5))
    for side in scene.hand_splats:
        torch.testing.assert_close(half[side], 0.25 * whole[side], atol=1e-5, rtol=1e-3)


def test_what_no_frame_looks_at_from_the_front_does_not_show(posed: tuple[Scene, Evidence]) -> None:
    """By how steeply the frame that faces it best looks at each of the object's Gaussians."""
    scene, evidence = posed
    everywhere = {entity: torch.ones_like(share) for entity, share in evidence.targets.shares.items()}
    evidence = replace(evidence, targets=replace(evidence.targets, shares=everywhere))
    found = shown(scene, evidence)["object"]
    with torch.no_grad():
        canonical, pose = scene.object_splats(), scene.at(torch.arange(scene.n_frames)).object
    normals = canonical.normals @ pose.rotations.transpose(-1, -2)
    sight = torch.nn.functional.normalize(
        pose.scale * canonical.means @ pose.rotations.transpose(-1, -2) + pose.centers[:, None], dim=-1
    )
    facing = (normals * sight).sum(-1).amin(0)  # -1 from the front, 1 from behind
    front, behind = facing < -0.7, facing > 0.3
    assert front.sum() > 50 and behind.sum() > 50
    assert found[front].quantile(0.75) > 0.9, "where no hand is before it"
    assert found[behind].median() < 0.05
    grazing = (facing > -0.25) & (facing < 0.0)
    assert found[grazing].mean() < 0.7 * found[front].mean()


def test_split_frees_gaussians_as_far_as_they_show(half_hidden: Scene) -> None:
    for splats in (*half_hidden.hand_splats.values(), half_hidden.object_splats):
        assert splats.freedom.min() < 0.01 and splats.freedom.max() > 0.5

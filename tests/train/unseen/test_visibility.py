"""What a clip shows of the hands' Gaussians: all of what their masks hold, nothing of what is covered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from limited_view import limited_view

from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.models.scene import Scene
from bigs.train.fit import fit
from bigs.train.loop.evidence import EvidenceSource
from bigs.train.loop.step import Evidence
from bigs.train.loop.target_source import TargetSource
from bigs.train.plan.config import PriorConfig, SplitStage
from bigs.train.plan.presets import SMOKE
from bigs.train.unseen.stages import OBSERVED_AT
from bigs.train.unseen.visibility import hands_shown
from bigs.types import HandObjectTrajectory, Side

PLAN = replace(
    SMOKE, prior=PriorConfig("off"), object=replace(SMOKE.object, n_gaussians=600), stages=SMOKE.stages[:1]
)


@pytest.fixture(scope="module")
def posed(
    whole_bottle: tuple[Clip, HandObjectTrajectory], both_hands: dict[Side, HandModel]
) -> tuple[Scene, Evidence]:
    clip = limited_view(*whole_bottle, range(6))
    scene, _ = fit(clip, both_hands, PLAN)
    nothing = np.zeros((len(clip), clip.height, clip.width), dtype=bool)
    return scene, EvidenceSource(TargetSource(clip, nothing), scene, PLAN, None).evidence(OBSERVED_AT)


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
    shown = hands_shown(scene, evidence)
    everything, nothing = (hands_shown(scene, masked(evidence, share)) for share in (1.0, 0.0))
    assert set(shown) == set(scene.hand_splats)
    for side, values in shown.items():
        assert len(values) == len(scene.hand_splats[side]().points)
        assert ((values >= 0.0) & (values <= everything[side] + 1e-6)).all()
        assert everything[side].max() > 0.9 and not nothing[side].any()
        # Where the estimates are about right, most of a hand lies in its mask.
        assert values.sum() > 0.5 * everything[side].sum()


def test_half_a_mask_counts_a_quarter(posed: tuple[Scene, Evidence]) -> None:
    scene, evidence = posed
    whole, half = (hands_shown(scene, masked(evidence, share)) for share in (1.0, 0.5))
    for side in whole:
        torch.testing.assert_close(half[side], 0.25 * whole[side], atol=1e-5, rtol=1e-3)


def test_split_frees_hands_as_far_as_they_show(half_hidden: Scene) -> None:
    for side in half_hidden.hand_splats:
        freedom = half_hidden.hand_splats[side].freedom
        assert freedom.min() < 0.01 and freedom.max() > 0.5

"""What a stage looks at: whether silhouettes lie right, and what counts as touching."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from bigs.data.base import Clip
from bigs.fused.outline import covered_shares
from bigs.hand import HandModel
from bigs.train.loop.evidence import EvidenceSource
from bigs.train.loop.step import Selection, Step
from bigs.train.loop.target_source import TargetSource
from bigs.train.loop.targets import crop_box, share_per_pixel
from bigs.train.plan.presets import FAST, SMOKE
from bigs.train.start.build import build_scene
from bigs.types import Side


@pytest.fixture
def source(tiny: Clip, both_hands: dict[Side, HandModel]) -> EvidenceSource:
    torch.manual_seed(0)
    unknown = np.zeros((len(tiny), tiny.height, tiny.width), dtype=bool)
    scene = build_scene(tiny, unknown, both_hands, SMOKE.initial, SMOKE.hand, SMOKE.object, False).scene
    return EvidenceSource(TargetSource(tiny, unknown), scene, SMOKE, None)


def test_only_grasps_count_as_touching_once_they_are_known(source: EvidenceSource) -> None:
    scene = source.scene
    assert source.touching()["right"].equal(source.meeting["right"])
    scene.grasps["right"].of_frame.copy_(torch.tensor([0] * 5 + [-1] * 7))
    assert source.touching()["right"].tolist() == [1.0] * 5 + [0.0] * 7
    # Of the other hand no grasp is known yet.
    assert source.touching()["left"].equal(source.meeting["left"])


@pytest.mark.parametrize("size", [60, 0])
def test_a_silhouette_is_as_large_as_the_hand(source: EvidenceSource, size: int) -> None:
    """An outline that is off by a per cent is paid for with a per cent of depth: most of a centimetre."""
    scene, side = source.scene, "right"
    stage = replace(next(s for s in FAST.stages if s.name == "hands-coarse"), image_size=size)
    targets = source.targets.at(size)
    position = scene.hand_poses[side].position
    with torch.no_grad():
        K = torch.as_tensor(source.clip.K, dtype=torch.float32)
        verts = scene.at(torch.arange(scene.n_frames)).verts(side)
        mask = covered_shares(verts, scene.hand_model(side).faces, K, source.clip.width, source.clip.height)
        x0, y0, x1, y1 = crop_box(source.clip)
        for t, shares in enumerate(mask):
            own = (shares > 0.5)[y0:y1, x0:x1].numpy()
            targets.shares[side][t] = share_per_pixel(own, targets.height, targets.width)
            for other in ("left", "object"):
                targets.shares[other][t] = 0.0
        evidence = source.evidence(stage)
        factors, costs = torch.linspace(0.97, 1.03, 31), []
        for factor in factors:
            position.log_depth.fill_(float(factor.log()))
            step = Step(scene, evidence, {}, Selection(torch.tensor([0, 6]), (side,)))
            costs.append(step.silhouette(side).item())
    best = int(np.argmin(costs))
    assert factors[best].item() == pytest.approx(1.0, abs=0.005)
    # A third of a pixel all around would cost more.
    assert costs[best] < 0.02

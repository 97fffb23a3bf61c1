"""What a stage looks at: whether cheap silhouettes lie right, and what counts as touching."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.losses.mask import amodal_silhouette
from bigs.models.hand_splats import pose_hand
from bigs.models.scene import Scene
from bigs.train.loop.evidence import EvidenceSource
from bigs.train.loop.step import Selection, Step
from bigs.train.loop.target_source import TargetSource
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


def hand_pixels(
    verts: np.ndarray, faces: np.ndarray, K: torch.Tensor, width: int, height: int
) -> torch.Tensor:
    """Share of each pixel [H, W] that a mesh [V, 3] covers, by 8 x 8 points a pixel in every triangle."""
    fine = 8
    corners = fine * (verts @ K.numpy().T)[:, :2] / verts[:, 2:]
    covered = np.zeros((fine * height, fine * width), dtype=bool)
    for a, b, c in corners[faces]:
        low = np.floor(np.minimum(np.minimum(a, b), c)).astype(int).clip(0)
        high = np.ceil(np.maximum(np.maximum(a, b), c)).astype(int)
        y, x = np.mgrid[low[1] : min(high[1], fine * height), low[0] : min(high[0], fine * width)]
        points = np.stack([x, y], axis=-1) + 0.5

        def side(p: np.ndarray, q: np.ndarray, points: np.ndarray = points) -> np.ndarray:
            return (q[0] - p[0]) * (points[..., 1] - p[1]) - (q[1] - p[1]) * (points[..., 0] - p[0])

        turns = np.stack([side(a, b), side(b, c), side(c, a)])
        inside = (turns >= 0).all(0) | (turns <= 0).all(0)
        covered[low[1] : low[1] + len(y), low[0] : low[0] + x.shape[1]] |= inside
    blocks = covered.reshape(height, fine, width, fine)
    return torch.as_tensor(blocks.mean((1, 3)), dtype=torch.float32)


def best_depth(scene: Scene, source: EvidenceSource, size: int) -> float:
    """At which factor on its depth does a hand's cheap silhouette fit its own mesh's outline best?"""
    stage = replace(next(s for s in FAST.stages if s.name == "hands-coarse"), image_size=size)
    evidence = source.evidence(stage)
    targets, side, frames = evidence.targets, "right", torch.tensor([0, 6])
    verts = scene.at(frames).verts(side).detach().numpy()
    faces = scene.hand_model(side).faces.numpy()
    step = Step(scene, evidence, {}, Selection(frames, (side,)))
    shares = [
        hand_pixels(v.astype(np.float64), faces, targets.K, targets.width, targets.height) for v in verts
    ]
    own = torch.stack(shares)
    factors = torch.linspace(0.96, 1.04, 17)
    costs = []
    with torch.no_grad():
        for factor in factors:
            scene.hand_poses[side].position.log_depth.fill_(float(factor.log()))
            posed = pose_hand(
                scene.hand_model(side),
                evidence.silhouettes[side],
                scene.hand_betas(side),
                scene.at(frames).canonical_hand(side),
                side,
            )
            alphas = step.render(posed).alphas[..., 0]
            costs.append(float(amodal_silhouette(alphas, own, torch.zeros_like(own))))
    return float(factors[int(np.argmin(costs))])


def test_a_silhouette_is_as_large_as_the_hand(source: EvidenceSource) -> None:
    """An outline that is off by a per cent is paid for with a per cent of depth: most of a centimetre."""
    assert abs(best_depth(source.scene, source, 0) - 1.0) < 0.011

"""Torch wakes other threads only in steps in which it has much to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from toy_stages import ALONE

from bigs.models.hand_detail import free_hand
from bigs.models.object_detail import split_object
from bigs.models.scene import Scene
from bigs.threads import thread_count
from bigs.train.loop.run_stage import _is_light, run_stage
from bigs.train.loop.step import Evidence, Step
from bigs.train.loop.terms import TERMS, Term
from bigs.train.plan.config import OptimizeStage

POSES_ONLY = replace(ALONE, steps=1, lrs={"hand.pose": 1e-3}, weights={"pose_prior": 1.0})
COLORS = replace(POSES_ONLY, lrs={"hand.color": 1e-3, "object.color": 1e-3}, weights={"color": 1.0})
FIELDS = replace(COLORS, lrs={"object.appearance": 1e-3})


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def threads_seen(
    scene: Scene, stage: OptimizeStage, evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> int:
    """How many threads torch had in the one step of a stage; afterwards it has two again."""
    (name,) = stage.weights
    term, counts = TERMS[name], []

    def counted(step: Step) -> Tensor:
        counts.append(thread_count())
        return term.loss(step)

    monkeypatch.setitem(TERMS, name, Term(counted, term.canonical))
    run_stage(scene, stage, evidence, 0)
    assert thread_count() == 2
    return counts[0]


def test_poses_need_no_second_thread(
    scene: Scene, evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert threads_seen(scene, POSES_ONLY, evidence, monkeypatch) == 1


def test_fields_do(scene: Scene, evidence: Evidence, monkeypatch: pytest.MonkeyPatch) -> None:
    assert threads_seen(scene, FIELDS, evidence, monkeypatch) == 2


def test_free_gaussians_do_not(scene: Scene, evidence: Evidence, monkeypatch: pytest.MonkeyPatch) -> None:
    scene.object_splats = split_object(scene.object_splats(), 1, 0.0)
    scene.hand_splats["right"] = free_hand(scene.hand_splats["right"])
    assert threads_seen(scene, COLORS, evidence, monkeypatch) == 1


@pytest.mark.parametrize("network", ["perceptual", "sds"])
def test_networks_do(scene: Scene, network: str) -> None:
    assert _is_light(scene, POSES_ONLY, [])
    assert not _is_light(scene, replace(POSES_ONLY, weights={"pose_prior": 1.0, network: 1.0}), [])

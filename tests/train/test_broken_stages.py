"""What the loop says when a stage cannot run or its loss breaks, and how it goes on where that passes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from toy_stages import ALONE, TOGETHER, values

from bigs.checks import InputError
from bigs.models.scene import Scene
from bigs.train.loop.run_stage import StageProgress, StageState, run_stage
from bigs.train.loop.step import Evidence
from bigs.train.loop.terms import TERMS
from bigs.train.plan.config import OptimizeStage

# --- what breaks ---


@pytest.mark.parametrize("stage", [ALONE, TOGETHER], ids=lambda stage: stage.name)
def test_an_unknown_term_is_named(scene: Scene, evidence: Evidence, stage: OptimizeStage) -> None:
    with pytest.raises(InputError, match=rf"stage {stage.name}: expected one of .* terms, found 'imagee'"):
        run_stage(scene, replace(stage, weights={"imagee": 1.0}), evidence, 0)


def test_coverage_belongs_to_the_single_subject_step(scene: Scene, evidence: Evidence) -> None:
    with pytest.raises(InputError, match="found 'coverage'"):
        run_stage(scene, replace(TOGETHER, weights={"coverage": 1.0}), evidence, 0)


def test_a_loss_that_is_not_finite_names_the_term(scene: Scene, evidence: Evidence) -> None:
    with torch.no_grad():
        scene.hand_poses["left"].pose[1, 3, 0] = float("nan")
    stage = replace(ALONE, lrs={"hand.pose": 1e-3}, weights={"orient_prior": 1.0, "pose_prior": 1.0})
    with pytest.raises(FloatingPointError, match=r"stage alone, step 0: pose_prior is not finite") as caught:
        run_stage(scene, stage, evidence, 0)
    assert "orient_prior" not in str(caught.value)


@pytest.mark.parametrize("term", ["image", "silhouette"])
def test_a_diverged_pose_is_reported_by_stage_and_term(scene: Scene, evidence: Evidence, term: str) -> None:
    """The user's input was fine: this is no InputError about 'means'."""
    with torch.no_grad():
        scene.hand_poses["right"].position.ray[0, 0] = float("nan")
    stage = replace(ALONE, lrs={"hand.ray": 1e-3}, weights={term: 1.0}, frames_per_step=0)
    with pytest.raises(FloatingPointError, match=rf"stage alone, step 0: .*{term}"):
        run_stage(scene, stage, evidence, 0)


def test_without_a_network_the_perceptual_term_is_refused(scene: Scene, evidence: Evidence) -> None:
    stage = replace(ALONE, weights={"perceptual": 1.0})
    with pytest.raises(InputError, match="expected a network for the term 'perceptual', found none"):
        run_stage(scene, stage, replace(evidence, perceptual=None), 0)


# --- what does not last ---


def faulty_at(monkeypatch: pytest.MonkeyPatch, *steps: int) -> list[int]:
    """Let `pose_prior` be NaN at its `steps`-th evaluations, counted from 1; returns the count of calls."""
    pending, calls, true = list(steps), [0], TERMS["pose_prior"]

    def term(step: object) -> torch.Tensor:
        calls[0] += 1
        value = true(step)
        if pending and calls[0] == pending[0]:
            pending.pop(0)
            return value * float("nan")
        return value

    monkeypatch.setitem(TERMS, "pose_prior", replace(true, loss=term))
    return calls


PRIOR = replace(
    TOGETHER,
    steps=12,
    lrs={"hand.pose": 1e-2},
    weights={"pose_prior": 1.0},
    frames_per_step=0,
)


def test_a_passing_fault_goes_back_to_the_kept_state_and_on_with_half_the_rates(
    scene: Scene, evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    with torch.no_grad():
        scene.hand_poses["left"].pose.fill_(0.5)
    calls = faulty_at(monkeypatch, 8)
    told: list[str] = []
    steps: list[int] = []
    state = run_stage(
        scene, PRIOR, evidence, 0, None, lambda p, s: steps.append(p.step), keep_every=5, warn=told.append
    )
    assert state.step == 12 and state.retreats == 1 and calls[0] == 15
    assert steps == [1, 2, 3, 4, 5, 6, 7, 6, 7, 8, 9, 10, 11, 12]
    assert len(told) == 1 and "step 7: pose_prior is not finite" in told[0] and "back to step 5" in told[0]
    assert state.optimizer.param_groups[0]["lr"] == pytest.approx(0.5e-2 * PRIOR.final_lr, rel=0.3)
    assert all(torch.isfinite(p).all() for p in scene.parameters())


def test_what_was_kept_is_what_the_stage_goes_on_from(
    scene: Scene, evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    with torch.no_grad():
        scene.hand_poses["left"].pose.fill_(0.5)
    faulty_at(monkeypatch, 3)
    poses: dict[int, list[torch.Tensor]] = {}

    def note(progress: StageProgress, _: StageState) -> None:
        poses.setdefault(progress.step, []).append(scene.hand_poses["left"].pose.detach().clone())

    before = values(scene)
    run_stage(scene, replace(PRIOR, steps=4), evidence, 0, None, note, keep_every=50)
    # The stage failed at its third step and began again from its very start, more slowly.
    first, second = poses[1]
    start = before["hand_poses.left.pose"]
    torch.testing.assert_close(second - start, 0.5 * (first - start), rtol=0.05, atol=1e-7)


def test_a_gradient_that_is_not_finite_is_named_and_not_taken(
    scene: Scene, evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    # sqrt of a square at zero: the value is fine, its derivative is 0 / 0.
    root = replace(
        TERMS["pose_prior"], loss=lambda step: step.scene.hand_poses["right"].pose.square().sum().sqrt()
    )
    monkeypatch.setitem(TERMS, "pose_prior", root)
    before = values(scene)
    with pytest.raises(FloatingPointError, match=r"the gradient of hand_poses\.right\.pose is not finite at"):
        run_stage(scene, PRIOR, evidence, 0)
    torch.testing.assert_close(values(scene)["hand_poses.right.pose"], before["hand_poses.right.pose"])

"""The prior as a stage of a run: with and without its weights, on an object that was seen, resumed."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bigs.checks import InputError
from bigs.cli import main
from bigs.commands.prior.weights import load_prior, with_prior
from bigs.data.base import Clip
from bigs.data.excerpt import excerpt
from bigs.guidance.pixel import PixelConfig, PixelDenoiser, PixelNet
from bigs.guidance.pixel_file import save_pixel_net
from bigs.hand import HandModel
from bigs.models.object_detail import ObjectDetail
from bigs.models.scene import Scene
from bigs.train.fit import fit
from bigs.train.fit_report import FitReport
from bigs.train.loop.evidence import EvidenceSource
from bigs.train.loop.step import Selection, Step
from bigs.train.loop.target_source import TargetSource
from bigs.train.plan.config import GuidanceStage, PriorConfig, RunConfig, SplitStage
from bigs.train.plan.presets import PRESETS, SMOKE
from bigs.train.resolve import resolve
from bigs.train.start import visual_hull
from bigs.train.unseen.visibility import SHOWS, image_error, overflow, weights_in_pictures
from bigs.types import Side

STAGE = GuidanceStage(steps=3, views=2, image_size=32)
# Gaussians enough that some are hidden by others in every frame.
PLAN = replace(SMOKE, object=replace(SMOKE.object, n_gaussians=3000), stages=(SplitStage(parts=1), STAGE))


@pytest.fixture(scope="module")
def prior() -> PixelDenoiser:
    torch.manual_seed(0)
    return PixelDenoiser(PixelNet(PixelConfig(width=16, embedding=32)))


@pytest.fixture(scope="module")
def one_side(tiny: Clip) -> Clip:
    """Five frames, in which one side shows."""
    return excerpt(tiny, torch.arange(5).numpy())


def run(
    clip: Clip, hands: dict[Side, HandModel], plan: RunConfig, prior: PixelDenoiser | None, **more: object
) -> tuple[Scene, FitReport]:
    return fit(clip, hands, plan, denoiser=prior, **more)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def before(one_side: Clip, both_hands: dict[Side, HandModel]) -> Scene:
    """What the prior finds. Read it, never change it."""
    return run(one_side, both_hands, replace(PLAN, stages=(SplitStage(parts=1),)), None)[0]


def test_the_unseen_part_moves_and_its_surface_follows(
    one_side: Clip, both_hands: dict[Side, HandModel], prior: PixelDenoiser, before: Scene
) -> None:
    plan = replace(PLAN, stages=(SplitStage(parts=1), replace(STAGE, damage=1e9)))
    after, report = run(one_side, both_hands, plan, prior)
    assert report.skipped == []
    assert "moved what was not seen by" in report.facts["prior"]
    change = (after.object_splats().means - before.object_splats().means).norm(dim=-1)
    assert 0.1 < float((change == 0).float().mean()) < 0.97
    # What nothing speaks for is no part of the mesh, whatever the prior believes of it.
    assert "object mesh" in report.facts and torch.equal(after.surface_faces, before.surface_faces)
    assert float((after.surface_verts - before.surface_verts).abs().max()) > 1e-5
    assert not any(parameter.requires_grad for parameter in after.parameters())


def test_what_shows_in_a_frame_stays(
    one_side: Clip, both_hands: dict[Side, HandModel], prior: PixelDenoiser, before: Scene
) -> None:
    """To the last bit, even where fewer frames show it than count as having seen it; nor does more show."""
    wild = replace(STAGE, steps=12, lr_shift=2e-3, damage=1e9, frame_weight=0.0)
    after, report = run(one_side, both_hands, replace(PLAN, stages=(SplitStage(parts=1), wild)), prior)
    assert "moved" in report.facts["prior"]
    nothing = np.zeros((5, one_side.height, one_side.width), dtype=bool)
    evidence = EvidenceSource(TargetSource(one_side, nothing), before, PLAN, None).evidence(
        replace(SMOKE.stages[0], image_size=240)
    )
    shown, now = (weights_in_pictures(scene, evidence) for scene in (before, after))
    changed = torch.zeros(len(shown), dtype=torch.bool)
    for name, value in before.object_splats.state_dict().items():
        changed |= (after.object_splats.state_dict()[name] != value).reshape(len(value), -1).any(1)
    assert int(changed.sum()) > 50 and float(shown[changed].max()) < SHOWS
    assert float(now[changed].max()) < 0.05


def test_a_prior_that_does_not_know_the_object_is_left_out(
    one_side: Clip, both_hands: dict[Side, HandModel], prior: PixelDenoiser, before: Scene
) -> None:
    """It is right about what it learned from, and not about this object: the scene stays as it was."""
    knowing = PixelDenoiser(prior.net, familiar=1e-4)
    after, report = run(one_side, both_hands, PLAN, knowing)
    assert "the prior does not know this object" in report.skipped[0]
    for name, value in before.state_dict().items():
        torch.testing.assert_close(after.state_dict()[name], value, rtol=0, atol=0)
    broad = replace(PLAN, stages=(SplitStage(parts=1), replace(STAGE, unlike=1e9, damage=1e9)))
    assert run(one_side, both_hands, broad, knowing)[1].skipped == []


def test_the_clips_frames_hold_what_they_show(
    one_side: Clip, both_hands: dict[Side, HandModel], prior: PixelDenoiser, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same wild prior changes what was seen less while held, though it still moves the rest."""
    # An object deeper than its outlines ask for, so that much of it hides next to what shows.
    monkeypatch.setattr(visual_hull, "far_side_depth", lambda *_: 0.08)
    before = run(one_side, both_hands, replace(PLAN, stages=(SplitStage(parts=1),)), None)[0]
    every = torch.arange(5)
    unknown = np.zeros((5, one_side.height, one_side.width), dtype=bool)
    evidence = EvidenceSource(TargetSource(one_side, unknown), before, PLAN, None).evidence(
        replace(SMOKE.stages[0], image_size=0)
    )
    step = Step(before, evidence, before.canonical(("object",)), Selection(every, ("object",), labels=False))
    # Pictures of what was found take the place of the clip's.
    found = replace(evidence, targets=replace(evidence.targets, images=step.together.colors.detach()))
    changes = []
    for weight in (0.0, 100.0):
        stage = replace(STAGE, steps=24, lr_shift=2e-4, damage=1e9, frame_weight=weight)
        scene, report = run(one_side, both_hands, replace(PLAN, stages=(SplitStage(parts=1), stage)), prior)
        assert "moved" in report.facts["prior"]
        changes.append(image_error(scene, found, ("object",), every))
    assert changes[1] < 0.5 * changes[0], changes
    assert float((scene.object_splats().means - before.object_splats().means).abs().max()) > 1e-4


def test_an_object_that_leaves_its_mask_is_measured(one_side: Clip, before: Scene) -> None:
    scene = copy.deepcopy(before)
    unknown = np.zeros((5, one_side.height, one_side.width), dtype=bool)
    evidence = EvidenceSource(TargetSource(one_side, unknown), scene, PLAN, None).evidence(
        replace(SMOKE.stages[0], image_size=0)
    )
    every = torch.arange(5)
    inside = overflow(scene, evidence, every)
    assert (inside >= 1.0).all() and (inside < 1.5).all()
    scene.object_splats.shift += 0.02
    assert (overflow(scene, evidence, every) > inside + 0.2).all()
    # Where anything may hide it, it may be.
    hidden = replace(
        evidence, targets=replace(evidence.targets, unknown=torch.ones_like(evidence.targets.unknown))
    )
    assert (overflow(scene, hidden, every) == 1.0).all()


def test_an_object_without_a_split_is_taken_out_of_its_field(
    one_side: Clip, both_hands: dict[Side, HandModel], prior: PixelDenoiser
) -> None:
    scene, _ = run(one_side, both_hands, replace(PLAN, stages=(STAGE,)), prior)
    assert isinstance(scene.object_splats, ObjectDetail)


def test_without_weights_one_line_says_so(one_side: Clip, both_hands: dict[Side, HandModel]) -> None:
    resolved = resolve(replace(PLAN, prior=PriorConfig("symmetry")))
    (note,) = resolved.notes
    assert "prior" in note and "--prior-weights" in note
    assert STAGE not in resolved.config.stages
    assert resolve(resolved.config) == resolved
    for silent in (resolve(PLAN), resolve(replace(PLAN, prior=PriorConfig("symmetry")), has_object=False)):
        assert silent.notes == [] and silent.config.stages == resolved.config.stages
    with pytest.raises(InputError, match="stage object-prior: expected a prior's model, found none"):
        run(one_side, both_hands, PLAN, None)


def test_an_object_that_was_seen_is_skipped(
    one_side: Clip, both_hands: dict[Side, HandModel], prior: PixelDenoiser
) -> None:
    for stage in (replace(STAGE, enough=0.01), replace(STAGE, well_seen=0.0)):
        _, report = run(one_side, both_hands, replace(PLAN, stages=(SplitStage(parts=1), stage)), prior)
        assert "of the object was seen" in report.skipped[0]


def test_a_clip_without_an_object_is_skipped(
    tiny: Clip, both_hands: dict[Side, HandModel], prior: PixelDenoiser
) -> None:
    _, report = run(replace(tiny, object=None), both_hands, replace(PLAN, stages=(STAGE,)), prior)
    assert report.skipped == [f"{STAGE.name}: the clip has no object"]


def test_a_finished_stage_is_not_lost_on_resume(
    one_side: Clip, both_hands: dict[Side, HandModel], prior: PixelDenoiser, tmp_path: Path
) -> None:
    """Surface and Gaussians come back from the checkpoint; the stage does not run again."""
    plan = replace(PLAN, stages=(SplitStage(parts=1), replace(STAGE, damage=1e9)))
    first, _ = run(one_side, both_hands, plan, prior, checkpoints=tmp_path)
    events: list[dict[str, object]] = []
    again, _ = run(one_side, both_hands, plan, prior, checkpoints=tmp_path, resume=True, listen=events.append)
    assert not any(event["event"] == "step" for event in events)
    torch.testing.assert_close(again.object_surface.verts, first.object_surface.verts, rtol=0, atol=0)


class _Killed(Exception):
    pass


@pytest.mark.parametrize("at", [3, 5])
def test_an_interrupted_stage_goes_on_at_its_step(
    one_side: Clip, both_hands: dict[Side, HandModel], prior: PixelDenoiser, tmp_path: Path, at: int
) -> None:
    """And ends in the same bits; the weights may have moved meanwhile, but not changed."""
    stage = replace(STAGE, steps=6, damage=1e9)
    plan = replace(PLAN, stages=(SplitStage(parts=1), stage), checkpoint_every=2)
    whole, report = run(one_side, both_hands, plan, prior)

    def kill(event: dict[str, object]) -> None:
        if event["event"] == "step" and event["step"] == at:
            raise _Killed

    with pytest.raises(_Killed):
        run(one_side, both_hands, plan, prior, checkpoints=tmp_path, listen=kill)
    torch.manual_seed(1)
    other = PixelDenoiser(PixelNet(PixelConfig(width=16, embedding=32)))
    with pytest.raises(InputError, match="found one of another run"):
        run(one_side, both_hands, plan, other, checkpoints=tmp_path, resume=True)
    events: list[dict[str, object]] = []
    moved = replace(plan, prior=replace(plan.prior, weights="elsewhere.safetensors"))
    again, told = run(
        one_side, both_hands, moved, prior, checkpoints=tmp_path, resume=True, listen=events.append
    )
    first = 2 * ((at - 1) // 2)
    assert [event["step"] for event in events if event["event"] == "step"] == [*range(first + 1, 7)]
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=0, atol=0)
    assert told.facts == report.facts


def test_what_the_options_mean(tmp_path: Path) -> None:
    file = str(tmp_path / "prior.safetensors")
    nothing = dict.fromkeys(("weights", "controlnet", "token", "edge_weights"), "")
    fast = PRESETS["fast"]
    assert with_prior(fast, "auto", "object", nothing) == fast
    assert with_prior(fast, "off", "object", nothing).prior.kind == "off"
    assert with_prior(fast, "auto", "object", {**nothing, "weights": file}).prior.kind == "trained"
    sd = with_prior(fast, "auto", "mug", {**nothing, "weights": "folder", "token": "t.safetensors"}).prior
    assert (sd.kind, sd.weights, sd.object_name, sd.token) == ("sd", "folder", "mug", "t.safetensors")
    with pytest.raises(InputError, match="--prior sd: expected --prior-weights"):
        with_prior(fast, "sd", "object", nothing)
    with pytest.raises(InputError, match="--prior-weights: expected a prior that uses it"):
        with_prior(fast, "symmetry", "object", {**nothing, "weights": file})
    with pytest.raises(InputError, match="--prior-token: expected a prior that uses it"):
        with_prior(fast, "trained", "object", {**nothing, "weights": file, "token": "t"})


def test_weights_are_loaded(tmp_path: Path) -> None:
    save_pixel_net(tmp_path / "prior.safetensors", PixelNet(PixelConfig(width=16, embedding=32)), 0.1)
    weights = str(tmp_path / "prior.safetensors")
    assert isinstance(load_prior(PriorConfig("trained", weights)), PixelDenoiser)
    assert load_prior(PriorConfig("symmetry")) is None
    (tmp_path / "sd").mkdir()
    with pytest.raises(InputError, match="sd"):
        load_prior(PriorConfig("sd", str(tmp_path / "sd")))


def test_a_run_refuses_missing_weights_before_it_begins(
    tiny_clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = tmp_path / "none.safetensors"
    command = ["reconstruct", str(tiny_clip), "--out", str(tmp_path / "run"), "--preset", "smoke"]
    with pytest.raises(SystemExit) as stop:
        main([*command, "--prior-weights", str(weights)])
    assert stop.value.code == 2
    assert f"{weights}: expected a file of bigs prior train" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()

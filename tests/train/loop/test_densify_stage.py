"""Densification within a stage: what it is told, what it is worth, and what interrupts it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from command_line import Answer
from safetensors import safe_open
from test_checkpoint import Interrupted, assert_same, interrupt_after
from torch import Tensor
from toy_stages import ALONE, held_cube, random_evidence

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.models.object_detail import split_object
from bigs.models.scene import Scene
from bigs.train.check_plan import check_plan
from bigs.train.fit import fit
from bigs.train.loop.checkpoint import FILE_NAME
from bigs.train.loop.evidence import EvidenceSource
from bigs.train.loop.run_stage import StageProgress, StageState, choose_frames, run_stage
from bigs.train.loop.step import Evidence, Selection, Step
from bigs.train.loop.target_source import TargetSource
from bigs.train.loop.terms import TERMS
from bigs.train.plan.config import OptimizeStage, RunConfig, SplitStage
from bigs.train.plan.config_file import from_plain, to_plain, with_changes
from bigs.train.plan.densify_config import DensifyConfig
from bigs.train.plan.presets import PRESETS
from bigs.train.start.background import unknown_occluders
from bigs.train.switches import without
from bigs.train.unseen.visibility import image_error
from bigs.types import Side

# Whoever is pulled at all: every other step from the second to the eighth.
EAGER = DensifyConfig(first=0.2, last=0.8, every=0.2, threshold=1e-9, floor=1, ceiling=100_000)
LRS = {"object.triplane": 1e-2, "object.geometry": 1e-3, "object.appearance": 1e-2}
STAGE = replace(ALONE, steps=10, lrs=LRS, weights={"image": 1.0, "coverage": 0.5}, densify=EAGER)


def count(scene: Scene) -> int:
    return len(scene.object_splats().means)


# --- what it is told ---


@pytest.mark.parametrize("smaller", [1, 2])
def test_pull_is_counted_per_pixel_and_half_of_the_clips_image(
    scene: Scene, evidence: Evidence, smaller: int
) -> None:
    """Against a loss that moves on screen: the mean over the mask, carried over to all pixels."""
    targets = replace(
        evidence.targets,
        K=evidence.targets.K / torch.tensor([smaller, smaller, 1.0])[:, None],
        width=evidence.targets.width // smaller,
        height=evidence.targets.height // smaller,
    )
    shares = {e: share[:, ::smaller, ::smaller] for e, share in targets.shares.items()}
    targets = replace(targets, images=targets.images[:, ::smaller, ::smaller], shares=shares)
    scene.requires_grad_(True)
    step = Step(
        scene,
        replace(evidence, targets=targets),
        scene.canonical(("right", "object")),
        Selection(torch.tensor([0, 2]), ("right", "object"), pull=True),
    )
    assert step.object_pull() is None
    pixels = step.alone("object").info["means2d"]
    share = step.share_alone("object")
    # As the terms do: a mean over the object's pixels in all views, and over the subjects.
    (0.5 * (pixels[..., 0].sum() + 3.0 * pixels[0, :, :, 1].sum()) / share.sum()).backward()
    pulled = step.object_pull()
    assert pulled is not None
    on_screen, shown, drift = pulled
    zoom = targets.K[0, 0] / scene.K[0, 0]
    per_pixel = 1.0 / (scene.width * scene.height * zoom**2)
    expected = torch.tensor([0.5 * scene.width, 3.0 * 0.5 * scene.height]) * zoom * per_pixel
    assert on_screen.shape == (2, count(scene), 2) and shown.shape == (2, count(scene)) and shown.any()
    torch.testing.assert_close(on_screen[0], expected.expand(count(scene), 2))
    torch.testing.assert_close(on_screen[1, :, 0], expected[:1].expand(count(scene)))
    assert drift.shape == (count(scene), 3) and drift[shown.any(0)].any(1).all()


def test_nothing_is_gathered_where_nobody_asks(
    scene: Scene, evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    true = Step.render

    def render(self: Step, gaussians: Any, means2d: Any = "values") -> Any:
        asked.append(means2d)
        return true(self, gaussians, means2d)

    monkeypatch.setattr(Step, "render", render)
    state = run_stage(scene, replace(STAGE, densify=None), evidence, 0)
    assert state.pull is None and set(asked) == {"values"}
    asked.clear()
    run_stage(scene, STAGE, evidence, 0)
    # Watched are the two steps before each time.
    assert asked == ["full"] * 8 + ["values"] * 2


# --- what it does ---


def test_gaussians_come_at_the_set_times_and_poses_stay(scene: Scene, evidence: Evidence) -> None:
    counts = {0: count(scene)}

    def note(progress: StageProgress, state: StageState) -> None:
        counts[progress.step] = count(scene)
        assert state.pull is not None and len(state.pull.total) == count(scene)

    run_stage(scene, STAGE, evidence, 0, after_step=note)
    rises = [step for step in range(1, 11) if counts[step] > counts[step - 1]]
    assert rises == [2, 4, 6, 8]
    anchors = scene.object_splats.anchors
    assert len({len(values) for values in anchors}) == 1
    assert all(values.isfinite().all() for values in scene.object_splats())


def test_transparent_ones_go_and_the_floor_holds(scene: Scene, evidence: Evidence) -> None:
    """A field that makes everything nearly invisible leaves as many as the floor asks for."""
    with torch.no_grad():
        scene.object_splats.appearance.opacity.bias.fill_(-10.0)
    before = count(scene)
    settings = replace(EAGER, large=10.0, floor=60)
    still = replace(STAGE, lrs={"object.geometry": 1e-9})
    run_stage(scene, replace(still, densify=replace(settings, least_opacity=8e-4)), evidence, 0)
    assert count(scene) == before  # at 0.0009 nobody is that transparent, or shows at all
    run_stage(scene, replace(still, densify=settings), evidence, 0)
    assert count(scene) == 60


def test_the_ceiling_holds(scene: Scene, evidence: Evidence) -> None:
    run_stage(scene, replace(STAGE, densify=replace(EAGER, ceiling=230)), evidence, 0)
    assert count(scene) == 230


def object_plan(gaussians: int, steps: int, densify: DensifyConfig | None) -> RunConfig:
    smoke = PRESETS["smoke"]
    appearance = next(stage for stage in smoke.stages if stage.name == "appearance")
    assert isinstance(appearance, OptimizeStage)
    stage = replace(
        appearance, steps=steps, lrs=LRS, weights={"image": 1.0, "coverage": 0.2}, densify=densify
    )
    return replace(
        smoke,
        object=replace(smoke.object, n_gaussians=gaussians),
        lighting=False,
        stages=(stage,),
        checkpoint_every=7,
    )


FEW = DensifyConfig(every=0.1, threshold=1e-5, small=0.05, large=10.0, floor=1, ceiling=5000)


@pytest.mark.slow
def test_too_few_gaussians_become_more_and_show_the_clip_better(
    tiny: Clip, both_hands: dict[Side, HandModel]
) -> None:
    found = {}
    for densify in (None, FEW):
        config = object_plan(40, 100, densify)
        scene, report = fit(tiny, both_hands, config)
        source = EvidenceSource(TargetSource(tiny, unknown_occluders(tiny, {}).pixels), scene, config, None)
        evidence = source.evidence(config.stages[0])
        error = image_error(scene, evidence, ("object",), torch.arange(len(tiny)))
        found[densify] = count(scene), error, report.facts.get("object Gaussians")
    (few, before, nothing), (many, after, said) = found[None], found[FEW]
    assert nothing is None and said == f"{few} at the start, {many} after appearance"
    assert many > 2 * few
    assert after < 0.95 * before


# --- what interrupts it ---


class Undisturbed(NamedTuple):
    config: RunConfig
    state: dict[str, Tensor]
    facts: dict[str, str]


@pytest.fixture(scope="module")
def undisturbed(tiny: Clip, both_hands: dict[Side, HandModel]) -> Undisturbed:
    # Only clones, which stand where all that was gathered points to.
    config = object_plan(40, 20, replace(FEW, first=0.25, every=0.15, small=10.0))
    scene, report = fit(tiny, both_hands, config)
    return Undisturbed(config, scene.state_dict(), report.facts)


# Checkpoints are kept at 7 and 14: between the times 5, 8 and after the last.
@pytest.mark.slow
@pytest.mark.parametrize("steps", [3, 8, 16])
def test_resumed_between_two_times_it_ends_the_same(
    tiny: Clip,
    both_hands: dict[Side, HandModel],
    undisturbed: Undisturbed,
    tmp_path: Path,
    steps: int,
) -> None:
    config, expected, facts = undisturbed
    with pytest.raises(Interrupted):
        fit(tiny, both_hands, config, checkpoints=tmp_path, listen=interrupt_after(steps))
    if steps == 8:
        with safe_open(tmp_path / FILE_NAME, framework="pt") as file:
            position = json.loads(file.metadata()["position"])
            views, points = file.get_tensor("pull.views"), file.get_tensor("scene.object_splats.base_points")
        assert position["step"] == 7
        assert len(points) == len(views) > 40  # more than a fresh scene has
        assert views.max() == 2 * 3  # two steps of three frames since the fifth
    torch.manual_seed(1234)
    scene, report = fit(tiny, both_hands, config, checkpoints=tmp_path, resume=True)
    assert_same(scene, expected)
    # What was left out is told with its seconds, which differ.
    assert {**report.facts, "left out": ""} == {**facts, "left out": ""}


def test_after_what_is_not_finite_it_goes_back_to_as_many_as_there_were(
    scene: Scene, evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fault comes after the number has changed; the stage then ends with all that is due."""
    calls, true = [0], TERMS["offset"]

    def faulty(step: Step) -> Tensor:
        calls[0] += 1
        return true(step) * (float("nan") if calls[0] == 8 else 1.0)

    monkeypatch.setitem(TERMS, "offset", replace(true, loss=faulty))
    counts: list[tuple[int, int]] = []
    told: list[str] = []
    state = run_stage(
        scene,
        replace(STAGE, weights={**STAGE.weights, "offset": 1e-3}),
        evidence,
        0,
        after_step=lambda progress, state: counts.append((progress.step, count(scene))),
        keep_every=5,
        warn=told.append,
    )
    assert len(told) == 1 and "back to step 5" in told[0]
    assert state.step == 10 and state.retreats == 1
    first, again = dict(counts[:7]), dict(counts[7:])
    assert list(again) == [6, 7, 8, 9, 10]
    # Kept were the fifth step's Gaussians and what had been gathered of them.
    assert first[5] < first[6] and first[5] < again[6] < again[8]
    assert state.pull is not None and len(state.pull.total) == count(scene)


def test_the_same_seed_gives_the_same_gaussians(both_hands: dict[Side, HandModel]) -> None:
    ends = []
    for seed in (0, 0, 1):
        scene = held_cube(both_hands)
        torch.manual_seed(seed + 50)
        run_stage(scene, STAGE, random_evidence(scene), seed)
        ends.append(scene.object_splats.base_points)
    assert torch.equal(ends[0], ends[1])
    assert ends[0].shape != ends[2].shape or not torch.equal(ends[0], ends[2])
    assert choose_frames(3, STAGE, 0, 0).tolist() != choose_frames(3, STAGE, 1, 0).tolist()


# --- where it does not belong, and settings that cannot be ---


def test_gaussians_without_a_field_are_refused(scene: Scene, evidence: Evidence) -> None:
    with torch.no_grad():
        scene.object_splats = split_object(scene.object_splats(), 1, 0.0)
    with pytest.raises(
        InputError, match="stage alone: expected densify in a stage in which the object has a field, found"
    ):
        run_stage(scene, replace(STAGE, lrs={**LRS, "hand.ray": 1e-3}), evidence, 0)


def test_a_clip_without_an_object_has_nothing_to_densify(scene: Scene, evidence: Evidence) -> None:
    scene.object_splats = None
    stage = replace(STAGE, lrs={**LRS, "hand.ray": 1e-3})
    assert run_stage(scene, stage, evidence, 0).pull is None


PAPER = PRESETS["paper"]


def paper_with(**settings: Any) -> RunConfig:
    return replace(
        PAPER,
        stages=tuple(
            replace(stage, **settings) if stage.name == "object" else stage for stage in PAPER.stages
        ),
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"first": 0.5}, r"expected 0 <= first <= last <= 1, found 0\.0, 0\.5, 0\.48, 1\.0"),
        ({"last": 1.5}, "expected 0 <= first <= last <= 1"),
        ({"first": -0.1}, r"\.first: expected 0 to 1e+"),
        ({"every": 0.0}, r"\.every: expected more than 0, found 0\.0"),
        ({"every": float("nan")}, r"\.every: expected .*found nan"),
        ({"threshold": -1e-4}, r"\.threshold: expected .*found -0\.0001"),
        ({"threshold": float("nan")}, r"\.threshold: expected .*found nan"),
        ({"small": 0.2}, r"expected 0 <= small <= large, found 0\.0, 0\.2, 0\.1"),
        ({"least_opacity": 1.1}, "expected 0 <= least_opacity <= 1"),
        ({"floor": 0}, "expected 1 <= floor <= ceiling"),
        ({"ceiling": 9_999}, "expected 1 <= floor <= ceiling, found 1, 10000, 9999"),
    ],
)
def test_numbers_out_of_range_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=rf"config.stages\.object\.densify.*{message}"):
        check_plan(paper_with(densify=DensifyConfig(**settings)))


def test_plans_in_which_it_could_not_work_are_refused() -> None:
    check_plan(PAPER)
    with pytest.raises(InputError, match="expected densify with step single-subject, found interacting"):
        check_plan(paper_with(step="interacting-subjects", weights={"image": 1.0}))
    with pytest.raises(
        InputError, match=r"densify: expected a rate for object\.geometry or object\.triplane"
    ):
        check_plan(paper_with(lrs={"object.appearance": 1e-3}))
    with pytest.raises(InputError, match="in which the object has a field, found one after split"):
        check_plan(replace(PAPER, stages=(SplitStage(), *PAPER.stages)))


def test_it_is_set_by_path_and_left_out_by_name() -> None:
    def densify(config: RunConfig) -> DensifyConfig | None:
        return next(stage.densify for stage in config.stages if stage.name in ("object", "appearance"))

    assert densify(PAPER) == DensifyConfig()
    assert densify(with_changes(PAPER, ["stages.object.densify.threshold=1e-4"])) == DensifyConfig(
        threshold=1e-4
    )
    assert densify(with_changes(PAPER, ["stages.object.densify=null"])) is None
    off = without(PAPER, "densify")
    assert densify(off) is None and off == paper_with(densify=None)
    smoke = PRESETS["smoke"]
    assert densify(smoke) is None and without(smoke, "densify") == smoke
    assert densify(with_changes(smoke, ["stages.appearance.densify={}"])) == DensifyConfig()
    assert from_plain(to_plain(PAPER)) == PAPER and from_plain(to_plain(off)) == off


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            "densify.treshold=1",
            "found 'treshold'; did you mean threshold",
        ),
        ("densify.floor=many", r"stages\.object\.densify\.floor: expected int, found 'many'"),
        ("densify=3", r"stages\.object\.densify: expected a mapping, found 3"),
        ("densify={flor: 3}", r"stages\.object\.densify: expected one of first, .*found 'flor'"),
    ],
)
def test_what_is_wrong_is_named_by_its_path(change: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        with_changes(PAPER, [f"stages.object.{change}"])


def test_the_command_line_refuses_it_before_anything_is_made(
    call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path
) -> None:
    change = "--set=stages.object.densify.ceiling=5"
    answer = call("reconstruct", tiny_clip, "--preset", "paper", "--out", tmp_path / "run", change)
    assert answer.code == 2 and "stages.object.densify: expected 1 <= floor <= ceiling" in answer.err
    assert not (tmp_path / "run").exists()

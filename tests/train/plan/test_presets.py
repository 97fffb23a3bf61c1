"""Presets are plans that can run: every name in them means something."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bigs.checks import InputError
from bigs.train.check_plan import check_plan
from bigs.train.loop.optim import GROUPS, ONLY_IN_FIELDS
from bigs.train.loop.terms import IMAGE_TERMS, TERMS
from bigs.train.plan.config import OptimizeStage, RefineStage, RunConfig
from bigs.train.plan.presets import PRESETS, SMOKE
from bigs.train.switches import without

STAGES = [
    pytest.param(stage, id=f"{name}-{stage.name}")
    for name, config in PRESETS.items()
    for stage in config.stages
    if isinstance(stage, OptimizeStage)
]


@pytest.mark.parametrize("stage", STAGES)
def test_groups_and_terms_exist(stage: OptimizeStage) -> None:
    assert stage.lrs
    assert set(stage.lrs) <= set(GROUPS)
    assert stage.weights
    assert set(stage.weights) <= set(TERMS) | set(IMAGE_TERMS[stage.step])


@pytest.mark.parametrize("stage", STAGES)
def test_numbers_make_sense(stage: OptimizeStage) -> None:
    assert stage.steps > 0
    assert all(lr > 0 for lr in stage.lrs.values())  # a frozen group is one that is not listed
    assert all(weight > 0 for weight in stage.weights.values())
    assert stage.image_size >= 0 and stage.frames_per_step >= 0
    assert 0 < stage.final_lr <= 1


@pytest.mark.parametrize("name", PRESETS)
def test_stage_names_are_unique(name: str) -> None:
    check_plan(PRESETS[name])
    names = [stage.name for stage in PRESETS[name].stages]
    assert len(set(names)) == len(names)
    # A stage's name is a key of --set paths, where a dot would part it.
    assert not any("." in stage for stage in names)


def test_every_preset_runs_both_of_the_papers_steps() -> None:
    for config in PRESETS.values():
        assert {stage.step for stage in config.stages} == {"single-subject", "interacting-subjects"}


def test_the_paper_preset_is_the_paper() -> None:
    """Eq. 5 to 9: terms, weights, what moves; where the paper is silent, the released code's numbers."""
    paper = PRESETS["paper"]
    hands, obj, translations = paper.stages
    image = {"image": 1.0, "ssim": 0.2, "perceptual": 1.0, "color": 0.1, "scale": 100.0, "mask": 10.0}
    assert hands.weights == {**image, "smooth": 1.0, "lbs": 1000.0}
    assert obj.weights == {**image, "sds": 1.0}
    contact = {"image": 1.0, "ssim": 0.2, "perceptual": 1.0, "mask": 10.0, "contact": 1.0}
    assert translations.weights == contact and paper.contact == "center"
    assert translations.lrs == {"hand.ray": 2e-3, "hand.depth": 2e-3}
    assert [stage.step for stage in paper.stages] == [*["single-subject"] * 2, "interacting-subjects"]
    assert [stage.steps for stage in paper.stages] == [15_000, 30_000, 30_000]
    assert all(stage.adam_betas == (0.9, 0.999) and stage.frames_per_step == 1 for stage in paper.stages)
    assert all(stage.image_size == 0 for stage in paper.stages), "the clip's own size"
    assert [stage.final_lr for stage in paper.stages] == [1.0, 1.0, 0.01]
    assert translations.decay == "exponential"
    for stage in (hands, obj):
        poses = {name for name in stage.lrs if name.split(".")[1] in ("orient", "pose", "ray", "depth")}
        assert {stage.lrs[name] for name in poses} == {1e-4}
        fields = {name: rate for name, rate in stage.lrs.items() if name not in poses}
        assert fields.pop("hand.skinning", 1e-4) == 1e-4 and set(fields.values()) == {1e-3}
    # No cap that could bind on a hand or on an object that it holds.
    assert min(paper.hand.max_offset, paper.object.max_offset) >= 1.0
    assert paper.prior.kind == "off" and not paper.lighting
    assert paper.initial.smooth_hands == paper.initial.smooth_object == 0.0


@pytest.mark.parametrize(
    ("stage", "group", "words"),
    [
        ("joint", "hand.geometry", "expected hand.geometry before the hand leaves its field, .* after split"),
        ("joint", "object.triplane", "expected object.triplane before the object leaves its field"),
        ("appearance", "hand.shift", "expected hand.shift after a split stage"),
        ("appearance", "scene.light", "expected scene.light with lighting, found lighting off"),
    ],
)
def test_a_rate_of_what_nothing_has_is_refused(stage: str, group: str, words: str) -> None:
    stages = tuple(replace(s, lrs={group: 1e-3}) if s.name == stage else s for s in SMOKE.stages)
    config = replace(SMOKE, stages=stages, lighting=group != "scene.light")
    with pytest.raises(InputError, match=rf"stages\.{stage}\.lrs: {words}"):
        check_plan(config)


def test_only_free_gaussians_are_refined() -> None:
    refine = next(stage for stage in SMOKE.stages if isinstance(stage, RefineStage))
    with pytest.raises(InputError, match=r"stages\.refine: expected it after a split stage, found none"):
        check_plan(replace(SMOKE, stages=(refine, *(s for s in SMOKE.stages if s is not refine))))


@pytest.mark.parametrize("name", ["smoke", "fast", "full"])
def test_without_the_split_fields_are_trained_to_the_end(name: str) -> None:
    kept = without(PRESETS[name], "split")
    check_plan(kept)
    joint = next(stage for stage in kept.stages if stage.name == "joint")
    assert {"hand.triplane", "hand.geometry", "object.appearance", "hand.color"} <= set(joint.lrs)
    assert not {"hand.shift", "object.opacity", "object.color"} & set(joint.lrs)


@pytest.mark.parametrize(("name", "trained"), [("demo", False), ("fast", False), ("full", True)])
def test_who_trains_fields_before_they_are_split(name: str, trained: bool) -> None:
    stages = [stage for stage in PRESETS[name].stages if isinstance(stage, OptimizeStage)]
    groups = set().union(*(stage.lrs for stage in stages))
    assert bool(groups & set().union(*ONLY_IN_FIELDS.values())) is trained


def test_image_terms_do_not_hide_other_terms() -> None:
    for terms in IMAGE_TERMS.values():
        assert not set(terms) & set(TERMS)


def test_a_plan_needs_stages_of_different_names() -> None:
    smoke = PRESETS["smoke"]
    with pytest.raises(ValueError, match="at least one stage, found none"):
        check_plan(RunConfig())
    with pytest.raises(ValueError, match="unique names, found 'object-prior' twice"):
        check_plan(RunConfig(stages=(smoke.stages[-1], smoke.stages[-1])))

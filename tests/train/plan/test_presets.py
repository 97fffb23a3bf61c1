"""Presets are plans that can run: every name in them means something."""

from __future__ import annotations

import pytest

from bigs.train.check_plan import check_plan
from bigs.train.loop.optim import GROUPS
from bigs.train.loop.terms import IMAGE_TERMS, TERMS
from bigs.train.plan.config import OptimizeStage, RunConfig
from bigs.train.plan.presets import PRESETS

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


def test_the_paper_preset_has_the_papers_terms() -> None:
    paper = {stage.name: stage for stage in PRESETS["paper"].stages}
    assert set(paper["hands"].weights) == {
        "image",
        "ssim",
        "perceptual",
        "color",
        "scale",
        "mask",
        "smooth",
        "lbs",
    }
    assert set(paper["object"].weights) == {"image", "ssim", "perceptual", "color", "scale", "mask"}
    assert "contact" in paper["translations"].weights
    assert set(paper["translations"].lrs) == {"hand.ray", "hand.depth"}
    assert PRESETS["paper"].contact == "center"


def test_image_terms_do_not_hide_other_terms() -> None:
    for terms in IMAGE_TERMS.values():
        assert not set(terms) & set(TERMS)


def test_a_plan_needs_stages_of_different_names() -> None:
    smoke = PRESETS["smoke"]
    with pytest.raises(ValueError, match="at least one stage, found none"):
        check_plan(RunConfig())
    with pytest.raises(ValueError, match="unique names, found 'object-prior' twice"):
        check_plan(RunConfig(stages=(smoke.stages[-1], smoke.stages[-1])))

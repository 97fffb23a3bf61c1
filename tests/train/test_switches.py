"""Every ingredient can be left out by its name, and what is left is a plan that can run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from bigs.checks import InputError
from bigs.models.object_splats import ObjectSplatsConfig
from bigs.train.check_plan import check_plan
from bigs.train.loop.terms import IMAGE_TERMS, TERMS
from bigs.train.plan.config import (
    GraspDepthStage,
    GraspStage,
    MoveStage,
    OptimizeStage,
    RunConfig,
    ScaleSearchStage,
    SplitStage,
)
from bigs.train.plan.presets import PRESETS
from bigs.train.switches import SWITCHES, without, without_all

FAST, PAPER = PRESETS["fast"], PRESETS["paper"]


def weights(config: RunConfig) -> set[str]:
    return {name for stage in config.stages if isinstance(stage, OptimizeStage) for name in stage.weights}


def groups(config: RunConfig) -> set[str]:
    return {name for stage in config.stages if isinstance(stage, OptimizeStage) for name in stage.lrs}


def kinds(config: RunConfig) -> set[type]:
    return {type(stage) for stage in config.stages}


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", SWITCHES)
def test_what_is_left_can_run(preset: str, name: str) -> None:
    before = PRESETS[preset]
    after = without(before, name)
    check_plan(after)
    assert without(after, name) == after  # nothing of it is left
    if name in {*TERMS, *IMAGE_TERMS["single-subject"], *IMAGE_TERMS["interacting-subjects"]}:
        assert name not in weights(after)
    assert all(stage.lrs and stage.weights for stage in after.stages if isinstance(stage, OptimizeStage))


def test_every_term_has_a_switch() -> None:
    for terms in (TERMS, *IMAGE_TERMS.values()):
        assert set(terms) <= set(SWITCHES)


def test_every_switch_does_something_somewhere() -> None:
    """No switch of a name that nothing answers to; what no preset uses is put into a plan here."""
    joint = next(stage for stage in FAST.stages if stage.name == "joint")
    assert isinstance(joint, OptimizeStage)
    names = ("offset", "smooth", "color", "mask_random")
    rest = replace(joint, name="rest", weights=dict.fromkeys(names, 1.0), stop_patience=9)
    plans = [*PRESETS.values(), replace(FAST, stages=(*FAST.stages, SplitStage(), rest))]
    idle = [name for name in SWITCHES if all(without(plan, name) == plan for plan in plans)]
    assert idle == []


def test_the_papers_switches() -> None:
    assert not without(FAST, "share").hand.shared
    smooth = without(FAST, "smooth")
    assert smooth.initial.smooth_hands == 0.0 and smooth.initial.smooth_object == FAST.initial.smooth_object
    assert not {"smooth", "acceleration"} & weights(smooth)
    assert weights(PAPER) - weights(without(PAPER, "smooth")) == {"smooth"}
    contact = without(FAST, "contact")
    assert weights(FAST) - weights(contact) == {"contact", "finger_contact", "penetration"}
    searches = {ScaleSearchStage, GraspDepthStage}
    assert searches <= kinds(FAST) and not searches & kinds(contact)
    # Without per-frame poses the paper's second step has nothing to move.
    assert [stage.name for stage in without(PAPER, "frame_poses").stages][:2] == ["hands", "object"]


def test_our_switches() -> None:
    grasps = without(FAST, "grasps")
    assert not {GraspStage, GraspDepthStage} & kinds(grasps)
    assert groups(FAST) - groups(grasps) == {"hand.grasp_orient", "hand.grasp_pose", "hand.grasp_position"}
    lighting = without(FAST, "lighting")
    assert not lighting.lighting
    assert groups(FAST) - groups(lighting) == {"scene.light", "scene.shade", "scene.ambient"}
    assert groups(FAST) - groups(without(FAST, "ambient")) == {"scene.ambient"}
    labels = without(FAST, "labels")
    assert {stage.labels_weight for stage in labels.stages if isinstance(stage, ScaleSearchStage)} == {0.0}
    sizes = [stage.image_size for stage in FAST.stages if isinstance(stage, OptimizeStage)]
    same = [stage.image_size for stage in without(FAST, "pyramid").stages if isinstance(stage, OptimizeStage)]
    assert len(set(sizes)) > 1 and set(same) == {max(sizes)}


def test_the_page_names_every_ingredient() -> None:
    page = (Path(__file__).parents[2] / "docs" / "cli.md").read_text()
    assert [name for name, switch in SWITCHES.items() if f"| `{name}` | {switch.text} |" not in page] == [
        name for name in SWITCHES if SWITCHES[name].text == f"the loss term {name}"
    ]


def test_a_preset_is_not_changed() -> None:
    before = {name: repr(config) for name, config in PRESETS.items()}
    for name in SWITCHES:
        without(FAST, name)
    assert {name: repr(config) for name, config in PRESETS.items()} == before


def test_several_and_what_was_not_there() -> None:
    config, unused = without_all(FAST, ["share", "color", "mse"])
    assert config == without(without(FAST, "share"), "mse")
    assert unused == ["color"]
    assert without_all(FAST, []) == (FAST, [])


def test_unknown_names_are_refused() -> None:
    with pytest.raises(InputError, match=r"--without: expected one of .*found 'shar'; did you mean share"):
        without(FAST, "shar")


def test_a_plan_does_not_become_empty() -> None:
    only = replace(FAST.stages[1], weights={"silhouette": 1.0})
    plan = RunConfig(object=ObjectSplatsConfig(), stages=(only, ScaleSearchStage()))
    with pytest.raises(InputError, match="--without silhouette: expected at least one stage to remain"):
        without_all(plan, ["silhouette"])


def test_leaving_out_parts_of_the_search_between_grasps() -> None:
    """The search has the rates and priors of stages, so it does without those that they do without."""

    def search(*names: str) -> MoveStage | None:
        stages = without_all(FAST, names)[0].stages
        return next((stage for stage in stages if isinstance(stage, MoveStage)), None)

    assert search() is not None and search("moves") is None
    assert search("pose_priors").weights == {"acceleration": search().weights["acceleration"]}
    assert "acceleration" not in search("smooth").weights
    assert "finger_tendons" not in search("finger_tendons").weights
    assert search("frame_poses") is None, "nothing is left that may move"

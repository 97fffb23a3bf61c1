"""Configurations as plain data: round trips, strict reading, and changes by path."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from bigs.checks import InputError
from bigs.train.plan.config import OptimizeStage, RefineStage, RunConfig, ScaleSearchStage, SplitStage
from bigs.train.plan.config_file import from_plain, load_config, save_config, to_plain, with_changes
from bigs.train.plan.presets import PRESETS


@pytest.mark.parametrize("name", PRESETS)
def test_presets_survive_a_round_trip(name: str, tmp_path: Path) -> None:
    save_config(tmp_path / "config.yaml", PRESETS[name], {"bigs": "1.2.3"})
    assert load_config(tmp_path / "config.yaml") == PRESETS[name]
    text = yaml.safe_load((tmp_path / "config.yaml").read_text())
    assert text["bigs"] == "1.2.3"
    assert list(text["config"]["stages"]) == [stage.name for stage in PRESETS[name].stages]


def test_plain_data_is_plain() -> None:
    def leaves(node: Any) -> list[Any]:
        if isinstance(node, dict):
            return [leaf for key, value in node.items() for leaf in [key, *leaves(value)]]
        return [leaf for value in node for leaf in leaves(value)] if isinstance(node, list) else [node]

    assert {type(leaf) for leaf in leaves(to_plain(PRESETS["full"]))} <= {str, int, float, bool, type(None)}


def plain() -> dict[str, Any]:
    return copy.deepcopy(to_plain(PRESETS["smoke"]))


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("sed",), 1, r"^f\.yaml: expected one of seed, .*found 'sed'; did you mean seed"),
        (("raster", "eps2"), 1, r"^f\.yaml\.raster: expected one of .*eps2d.*found 'eps2'; did you mean"),
        (("raster", "eps2d"), "wide", r"^f\.yaml\.raster\.eps2d: expected float, found 'wide'"),
        (("raster", "eps2d"), True, r"^f\.yaml\.raster\.eps2d: expected float, found True"),
        (("raster", "tile_size"), 16.5, r"^f\.yaml\.raster\.tile_size: expected int, found 16\.5"),
        (("raster",), 3, r"^f\.yaml\.raster: expected a mapping, found 3"),
        (("lighting",), 1, r"^f\.yaml\.lighting: expected bool, found 1"),
        (("contact",), "sides", r"^f\.yaml\.contact: expected one of center, surface, found 'sides'"),
        (("hand", "color"), [1, 2], r"^f\.yaml\.hand\.color: expected 3 values, found \[1, 2\]"),
        (("hand", "color"), [1, 2, "x"], r"^f\.yaml\.hand\.color\[2\]: expected float, found 'x'"),
        (("hand", "triplane", "features"), None, r"hand\.triplane\.features: expected int, found None"),
        (("stages",), [], r"^f\.yaml\.stages: expected stages by name, found \[\]"),
        (("stages", "joint"), 5, r"^f\.yaml\.stages\.joint: expected a stage, found 5"),
        (
            ("stages", "joint", "step"),
            "both",
            r"stages\.joint\.step: expected one of single-subject, .*'both'",
        ),
        (("stages", "joint", "steps"), "many", r"stages\.joint\.steps: expected int, found 'many'"),
        (("stages", "joint", "stepz"), 5, r"stages\.joint: expected one of .*'stepz'; did you mean step"),
        (("stages", "joint", "lrs"), 5, r"stages\.joint\.lrs: expected a mapping, found 5"),
        (("stages", "joint", "lrs", "hand.ray"), "fast", r"stages\.joint\.lrs\.hand\.ray: expected float"),
        (("stages", "object-scale-search", "spam"), 1, r"object-scale-search: expected .*span.*'spam'"),
        (("stages", "object-scale-search", "span"), "x", r"object-scale-search\.span: expected float"),
    ],
)
def test_what_is_wrong_is_named_by_its_path(path: tuple[str, ...], value: Any, message: str) -> None:
    data = plain()
    node = data
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    with pytest.raises(InputError, match=message):
        from_plain(data, "f.yaml")


def test_a_missing_key_is_named() -> None:
    data = plain()
    del data["stages"]["joint"]["steps"]
    with pytest.raises(InputError, match=r"^c\.stages\.joint: expected a key 'steps', found name, step, lrs"):
        from_plain(data, "c")


def test_defaults_fill_what_is_left_out() -> None:
    stages = {"one": {"step": "single-subject", "steps": 3, "lrs": {"hand.ray": 1}, "weights": {"mask": 1}}}
    config = from_plain({"stages": stages})
    only = OptimizeStage("one", "single-subject", 3, {"hand.ray": 1.0}, {"mask": 1.0})
    assert config == RunConfig(stages=(only,))
    assert type(config.stages[0].weights["mask"]) is float


@pytest.mark.parametrize("kind", [SplitStage, RefineStage])
def test_the_kind_of_a_stage_is_the_one_that_has_its_keys(kind: type) -> None:
    config = RunConfig(stages=(kind(name="a"), kind(name="b", parts=3)))
    assert from_plain(to_plain(config)) == config


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a: [1,", "expected YAML"),
        (b"- 1\n", "expected a key 'config', found list"),
        (b"", "expected a key 'config', found NoneType"),
        (b"bigs: 1\n", "expected a key 'config'"),
        (b"\xff\xfe\x00config", "expected"),
        (b"config: {? [1, 2] : 3}\n", "expected"),
        (b"config: !!python/object/apply:os.getcwd []\n", "expected YAML"),
    ],
)
def test_files_that_are_no_configuration(tmp_path: Path, content: bytes, message: str) -> None:
    file = tmp_path / "config.yaml"
    file.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_config(file)
    assert str(caught.value).startswith(str(file))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a configuration file, found no such file"):
        load_config(tmp_path / "config.yaml")
    with pytest.raises(InputError, match="expected a configuration file"):
        load_config(tmp_path)


@pytest.fixture
def smoke() -> RunConfig:
    return copy.deepcopy(PRESETS["smoke"])


def stage(config: RunConfig, name: str) -> Any:
    return next(s for s in config.stages if s.name == name)


def test_changes_by_path(smoke: RunConfig) -> None:
    old = PRESETS["smoke"]
    new = with_changes(
        smoke,
        [
            "seed=3",
            "raster.eps2d=0.2",
            "lighting=false",
            "contact=center",
            "hand.color=[0.1, 0.2, 0.3]",
            "hand.triplane.features=7",
            "stages.joint.steps=50",
            "stages.joint.lrs.hand.pose=0.01",
            "stages.joint.weights.mask=1e-3",
            "stages.object-scale-search.span=0.2",
        ],
    )
    assert (new.seed, new.raster.eps2d, new.lighting, new.contact) == (3, 0.2, False, "center")
    assert new.hand.color == (0.1, 0.2, 0.3)
    assert new.hand.triplane.features == 7
    assert stage(new, "joint").steps == 50
    assert stage(new, "joint").lrs == {**stage(old, "joint").lrs, "hand.pose": 0.01}
    assert stage(new, "joint").weights == {**stage(old, "joint").weights, "mask": 1e-3}
    assert stage(new, "object-scale-search") == ScaleSearchStage(span=0.2, candidates=15)
    untouched = [s for s in old.stages if s.name not in ("joint", "object-scale-search")]
    assert [s for s in new.stages if s.name not in ("joint", "object-scale-search")] == untouched


def test_a_weight_or_a_rate_may_be_new(smoke: RunConfig) -> None:
    old = PRESETS["smoke"]
    assert "smooth" not in stage(old, "joint").weights
    assert "object.depth" not in stage(old, "joint").lrs
    new = with_changes(smoke, ["stages.joint.weights.smooth=2", "stages.joint.lrs.object.depth=0.5"])
    assert stage(new, "joint").weights["smooth"] == 2.0
    assert stage(new, "joint").lrs["object.depth"] == 0.5


def test_the_last_change_of_a_path_wins(smoke: RunConfig) -> None:
    assert with_changes(smoke, ["seed=1", "seed=2"]).seed == 2


def test_what_is_changed_is_a_copy(smoke: RunConfig) -> None:
    """Presets share stages with each other; a change in one run must not reach the next."""
    with_changes(
        smoke, ["stages.joint.lrs.hand.ray=9", "stages.joint.weights.mask=9", "hand.color=[0.1, 0.1, 0.1]"]
    )
    assert smoke == PRESETS["smoke"]


@pytest.mark.parametrize(
    "change",
    [
        "seed",
        "=3",
        "sed=3",
        "seed.x=3",
        "raster=3",
        "raster.eps2=3",
        "raster.eps2d=wide",
        "raster.eps2d=",
        "raster.eps2d=[",
        "raster.eps2d={a: 1",
        "stages.nope.steps=3",
        "stages.joint.stepz=3",
        "stages.joint.steps=1.5",
        "stages.joint.lrs.hand.ray=fast",
        "stages.joint.lrs=0.1",
        "weights.mask=1",
        "lrs=1",
    ],
)
def test_changes_that_cannot_be(change: str, smoke: RunConfig) -> None:
    with pytest.raises(InputError, match="--set") as caught:
        with_changes(smoke, [change])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("stages.joint.weights.spill=1", "expected alpha_outside, as it is called now, found spill"),
        ("stages.object-prior.hold=1", "expected frame_weight, as it is called now, found hold"),
        (
            "stages.object-motion.tracker.map.least_sightings=4",
            "expected least_observations, as it is called now, found least_sightings",
        ),
    ],
)
def test_an_old_name_is_refused_with_the_new_one(change: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        with_changes(PRESETS["fast"], [change])
    plain = to_plain(PRESETS["fast"])
    path, value = change.split("=")
    node = plain
    for key in path.split(".")[:-1]:
        node = node[key]
    node[path.split(".")[-1]] = int(value)
    with pytest.raises(InputError, match=words):
        from_plain(plain, "config.yaml")


def test_an_old_stage_is_refused_with_the_new_one() -> None:
    with pytest.raises(InputError, match="expected grasped, as it is called now, found held"):
        with_changes(PRESETS["fast"], ["stages.held.steps=1"])
    # Stages are named freely, so one may be called that again.
    own = replace(PRESETS["fast"], stages=(replace(PRESETS["fast"].stages[1], name="held"),))
    assert with_changes(own, ["stages.held.steps=1"]).stages[0].steps == 1

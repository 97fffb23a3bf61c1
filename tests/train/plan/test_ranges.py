"""Numbers that make no sense are refused where a configuration is read, by their path."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from bigs.checks import InputError
from bigs.train.check_plan import check_plan
from bigs.train.plan.config import RunConfig
from bigs.train.plan.config_file import load_config, with_changes
from bigs.train.plan.presets import FULL, PRESETS
from bigs.train.plan.ranges import RANGES, check_ranges


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_within(name: str) -> None:
    check_ranges("config", PRESETS[name])


def test_every_range_is_of_a_number_that_exists() -> None:
    for kind, ranges in RANGES.items():
        assert set(ranges) <= {entry.name for entry in dataclasses.fields(kind)}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("raster.eps2d=.nan", r"raster\.eps2d: expected 0 to .* found nan"),
        ("raster.far_plane=.inf", r"raster\.far_plane: .* found inf"),
        ("stages.joint.weights.image=.nan", r"weights\.image: .* found nan"),
        ("stages.joint.weights.my_term=-1", r"weights\.my_term: .* found -1"),
        ("stages.joint.lrs.hand.orient=-0.1", r"lrs\.hand\.orient: .* found -0.1"),
        ("stages.joint.lrs.hand.orient=1e300", r"lrs\.hand\.orient: .* found 1e\+300"),
        ("stages.object-motion.calibrated_automatic=1.5", r"calibrated_automatic: .* found 1\.5"),
        ("stages.joint.steps=-1", r"joint\.steps: .* found -1"),
        ("stages.object-prior.t_first=[0.5, .nan]", r"t_first\[1\]: .* found nan"),
        ("hand.color=[0.5, 0.5, 1.0]", r"hand\.color\[2\]: .* less than 1, found 1"),
        ("object.triplane.resolution=1000000", r"triplane\.resolution: .* found 1000000"),
        ("seed=-1", r"seed: .* found -1"),
        (f"seed={2**63}", rf"seed: expected 0 to {2**63 - 1}, found {2**63}"),
        (f"seed={10**400}", "seed.*: .* found"),
        ("seed=" + "9" * 5000, "seed=99.* found"),
        (f"raster.eps2d={10**400}", "eps2d.*: .* found"),
        ("seed=2001-99-99", "seed=.*: expected .* found"),
        ("raster.eps2d=" + "[" * 3000, r"raster\.eps2d=.*: expected .* found"),
    ],
)
def test_a_number_out_of_range(change: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as raised:
        with_changes(FULL, [change])
    assert len(str(raised.value)) < 400


@pytest.mark.parametrize("seed", [0, 2**63 - 1])
def test_the_ends_of_a_range(seed: int) -> None:
    assert with_changes(FULL, [f"seed={seed}"]).seed == seed


def test_a_file_of_numbers_that_python_does_not_print(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("config: {seed: " + "9" * 5000 + "}\n")
    with pytest.raises(InputError, match=r"config\.yaml: "):
        load_config(file)
    file.write_text("config: {1: 2}\n")
    with pytest.raises(InputError, match=r"config\.yaml: .* found 1"):
        load_config(file)


def test_a_plan_made_by_a_program_is_checked_too() -> None:
    with pytest.raises(InputError, match=r"config\.seed"):
        check_plan(RunConfig(seed=-1, stages=FULL.stages))

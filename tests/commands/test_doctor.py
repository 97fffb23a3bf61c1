"""`bigs doctor` tells the truth about this machine, and about one that lacks things."""

from __future__ import annotations

import importlib.util
import re
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from command_line import Answer

import bigs
from bigs import _raster
from bigs.commands.doctor import DISTRIBUTIONS, EXTRAS, REQUIRED, examine

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]


def names(requirements: list[str]) -> set[str]:
    return {re.split(r"[<>=!~]", requirement)[0] for requirement in requirements}


def test_it_knows_every_package_and_every_extra() -> None:
    assert {DISTRIBUTIONS.get(module, module) for module in REQUIRED} == names(PROJECT["dependencies"])
    assert set(EXTRAS) == set(PROJECT["optional-dependencies"])
    for name, extra in EXTRAS.items():
        wanted = names(PROJECT["optional-dependencies"][name])
        assert {DISTRIBUTIONS.get(module, module) for module in extra.modules} <= wanted, name
        assert name == "dev" or len(extra.modules) == len(wanted), name


def test_the_command(call: Callable[..., Answer]) -> None:
    answer = call("doctor")
    assert (answer.code, answer.err) == (0, "")
    for word in (bigs.__version__, torch.__version__, f"instructions {_raster.simd_level()}", "pycolmap"):
        assert word in answer.out
    assert "broken" not in answer.out


def test_what_is_missing_says_what_it_would_enable(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec

    def without_viser(name: str, *arguments: Any) -> Any:
        return None if name in ("viser", "gsply") else find(name, *arguments)

    monkeypatch.setattr("importlib.util.find_spec", without_viser)
    monkeypatch.setenv("BIGS_BENCH", "/nowhere/at/all")
    found = {finding.name: finding for _, group in examine() for finding in group}
    assert found["viewer"] == ("viewer", "missing", "pip install 'bigs[viewer]' would enable bigs view")
    assert "spz" in found["export"].detail and found["export"].state == "missing"
    assert found["BIGS_BENCH"].state == "broken" and "/nowhere/at/all" in found["BIGS_BENCH"].detail


def test_a_package_that_does_not_load_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rtree", None)
    found = {finding.name: finding for _, group in examine() for finding in group}
    assert found["rtree"].state == "broken" and "bigs needs it" in found["rtree"].detail

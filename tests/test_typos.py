"""Slips on the command line: the sentence names what was probably meant."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from command_line import Answer, assert_refused

from bigs.checks import InputError
from bigs.cli.app import COMMANDS
from bigs.cli.typos import check_words, words_of


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("recnstruct x", "expected one of 15 commands, found 'recnstruct'; did you mean reconstruct?"),
        (
            "bench engin",
            "found 'engin'; did you mean engine?",
        ),
        ("reconstruct x --out y --presett fast", "found --presett; did you mean --preset?"),
        ("reconstruct x --out y --thread=1", "found --thread; did you mean --threads?"),
        (
            "reconstruct x --out y --preset fst",
            "smoke, demo, fast, full, paper, found 'fst'; did you mean",
        ),
        ("reconstruct x --out y --preset=fst", "found 'fst'; did you mean fast?"),
        ("reconstruct x", "reconstruct: expected --out, found none (see bigs reconstruct --help)"),
        ("reconstruct --out y", "expected CLIP, found none"),
        (
            "reconstruct x fast --out y",
            "CLIP and options, found 'fast'; did you mean --preset fast?",
        ),
        ("reconstruct x --out y --threads two", "--threads: expected a whole number, found 'two'"),
        ("prior train x --out y --lr much", "--lr: expected a number, found 'much'"),
        ("demo --out", "--out: expected a value, found none"),
        ("demo -x", "found -x (see bigs demo --help)"),
        ("bench engine --parts stages memry", "found 'memry'; did you mean memory?"),
        ("prior", "prior: expected a command (fit, train), found none"),
    ],
)
def test_what_was_meant_is_named(line: str, sentence: str) -> None:
    with pytest.raises(InputError) as refused:
        check_words(COMMANDS, line.split())
    assert sentence in str(refused.value)
    assert "None" not in str(refused.value)


@pytest.mark.parametrize(
    "line",
    [
        "demo --threads -1",
        "eval a b c --out d",
        "export a --format ply --frames 0 1 2 --out b",
        "bench engine --threads 1 2 --parts stages memory",
        "prior train meshes --out f --lr 1e-3",
        "preprocess all v --out c --K 1 2 3 4 --mask-labels right=1 left=2",
        "reconstruct c --out d --set seed=-3 --set raster.eps2d=1 --without share --hand_model m",
        "reconstruct --out d --resume c",
        "batch m --out o --slurm a=1 --slurm b=2",
        "submission z --runs a b --sequences c d",
        "demo --help",
        "bench --help",
        "reconstruct --help --bogus",
    ],
)
def test_good_lines_pass(line: str) -> None:
    check_words(COMMANDS, line.split())


def _commands(node: Any, path: str = "") -> Iterator[Any]:
    for name, inner in node.items():
        if callable(inner):
            yield pytest.param(f"{path}{name}", inner, id=f"{path}{name}")
        else:
            yield from _commands(inner, f"{path}{name} ")


@pytest.mark.parametrize(("path", "command"), list(_commands(COMMANDS)))
def test_the_words_are_those_of_the_parser(call: Callable[..., Answer], path: str, command: Any) -> None:
    """Every option that the parser's help shows is known here, and no other."""
    lines = call(*path.split(), "--help").out.splitlines()
    heads = [found[1] for found in map(re.compile(r"[│ ] (-[\w-]+(, -[\w-]+)*)").match, lines) if found]
    shown = {name for head in heads for name in re.findall(r"--[\w-]+", head)}
    assert {option.name for option in words_of(command)[0]} == shown - {"--help"}


def test_a_slip_in_a_sub_command_is_no_source(call: Callable[..., Answer]) -> None:
    assert_refused(call("preprocess", "fames", "x"), "found 'fames'", "did you mean frames?")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("stages.joint.step=6", "--set stages.joint.step: expected one of .* found 6; did you mean steps"),
        ("stages.jont.steps=6", "expected one of .*, found 'jont'; did you mean joint"),
        ("stages.contact.weights.contct=1", "found 'contct'; did you mean contact"),
    ],
)
def test_settings_that_are_nearly_right(change: str, words: str) -> None:
    from bigs.train.check_plan import check_plan
    from bigs.train.plan.config_file import with_changes
    from bigs.train.plan.presets import PRESETS

    with pytest.raises(InputError, match=words):
        check_plan(with_changes(PRESETS["full"], [change]))

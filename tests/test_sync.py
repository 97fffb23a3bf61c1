"""Things that are said twice, for speed or for another language, say the same."""

from __future__ import annotations

import re
import tomllib
import typing
from importlib.metadata import entry_points, version
from pathlib import Path

import bigs
from bigs.cli import runs, terminal
from bigs.cli.__main__ import run
from bigs.commands.export.formats import FORMATS
from bigs.commands.render import views
from bigs.train.plan.presets import PRESETS

ROOT = Path(__file__).parents[1]


def test_the_command_line_knows_every_preset() -> None:
    assert typing.get_args(terminal.Preset) == tuple(PRESETS)


def test_the_command_line_knows_every_format() -> None:
    assert typing.get_args(runs.Format) == FORMATS


def test_the_command_line_knows_how_to_render() -> None:
    for name in ("World", "About", "DepthFormat"):
        assert typing.get_args(getattr(runs, name)) == typing.get_args(getattr(views, name))


def test_one_version() -> None:
    cargo = tomllib.loads((ROOT / "Cargo.toml").read_text())
    assert bigs.__version__ == version("bigs") == cargo["workspace"]["package"]["version"]


def test_the_console_script_is_the_process() -> None:
    (script,) = entry_points(group="console_scripts", name="bigs")
    assert script.load() is run


def test_the_python_version_is_said_once() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    manifest = (ROOT / "rust" / "py" / "Cargo.toml").read_text()
    minor = re.search(r"abi3-py3(\d+)", manifest)
    assert minor is not None
    assert project["requires-python"] == f">=3.{minor[1]}"

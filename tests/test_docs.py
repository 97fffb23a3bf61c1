"""What the documentation names exists: links between its pages, modules and functions, commands."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from bigs.cli.app import COMMANDS

ROOT = Path(__file__).parents[1]
DOCS = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
NAMED = re.compile(r"`(bigs(?:\.\w+)+)")


@pytest.mark.parametrize("page", DOCS, ids=lambda page: page.stem)
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text()
    for target in re.findall(r"\]\(([^)]+)\)", text):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        file = page.parent / name if name else page
        assert file.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", file.read_text(), re.M)
            slugs = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor in slugs, target


@pytest.mark.parametrize("page", DOCS, ids=lambda page: page.stem)
def test_names_of_the_package_exist(page: Path) -> None:
    for name in NAMED.findall(page.read_text()):
        parts = name.split(".")
        found: object = importlib.import_module(parts[0])
        for depth, part in enumerate(parts[1:], start=2):
            if not hasattr(found, part):
                importlib.import_module(".".join(parts[:depth]))
            found = getattr(found, part)


@pytest.mark.parametrize("page", DOCS, ids=lambda page: page.stem)
def test_commands_exist(page: Path) -> None:
    for block in re.findall(r"^```.*?^```", page.read_text(), re.M | re.S):
        for name in re.findall(r"^bigs ([a-z]+)", block, re.M):
            assert name in COMMANDS, name


@pytest.mark.parametrize("page", DOCS, ids=lambda page: page.stem)
def test_files_of_the_repository_exist(page: Path) -> None:
    """Paths are given from the root of the repository or from `bigs`."""
    for path in re.findall(r"`((?:[a-z][\w-]*/)+[\w-]+\.(?:py|rs))\b", page.read_text()):
        assert (ROOT / path).exists() or (ROOT / "bigs" / path).exists(), path

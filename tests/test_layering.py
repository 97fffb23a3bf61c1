"""Who may import whom, read from the source: the diagram in the docs cannot drift from the code.

Imports inside functions and under TYPE_CHECKING count like any other.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

import bigs

ROOT = Path(bigs.__file__).parent

# A part is a top-level module or package of bigs; "bigs" itself is its version. Each may import itself and
# what its entry names. Siblings are apart; what they share lies below them.
BELOW = {
    "types",
    "checks",
    "names",
    "files",
    "archives",
    "checksum",
    "atomic",
    "unpickle",
    "torch_files",
    "weights",
    "threads",
}
MAY_IMPORT: dict[str, set[str]] = {
    "bigs": set(),
    "types": set(),
    "threads": set(),
    "checks": set(),
    "checksum": set(),
    "names": {"checks"},
    "files": {"checks"},
    "archives": {"checks", "files"},
    "colmap": set(),
    "atomic": set(),
    "pickle_records": set(),
    "unpickle": {"checks", "files", "archives", "pickle_records"},
    "torch_files": {"checks", "archives", "pickle_records", "unpickle"},
    "weights": {"checks", "files", "torch_files"},
    "_raster": {"raster"},  # the compiled module's stub names the settings class
    "fused": {"_raster"},
    "geometry": BELOW | {"fused"},
    "raster": BELOW | {"geometry", "_raster"},
    "hand": BELOW | {"geometry", "fused"},
    "fields": BELOW | {"geometry"},
    "losses": BELOW | {"geometry"},
    "guidance": BELOW | {"geometry"},
    "data": BELOW | {"geometry", "colmap"},
    "metrics": BELOW | {"geometry", "fused"},
    "export": BELOW | {"geometry"},
    "motion": BELOW | {"geometry", "colmap", "_raster"},
    "preprocess": BELOW | {"geometry", "hand", "data", "colmap", "motion"},
    "viewer": {"types", "checks", "atomic"},
    "models": BELOW | {"geometry", "fused", "hand", "fields"},
}
MAY_IMPORT["train"] = {
    *MAY_IMPORT["models"],
    "bigs",
    "raster",
    "losses",
    "guidance",
    "data",
    "metrics",
    "models",
    "motion",
}
MAY_IMPORT["bench"] = BELOW | {"bigs", "raster", "_raster"}
MAY_IMPORT["commands"] = set(MAY_IMPORT) - {"_raster"}
MAY_IMPORT["cli"] = {"bigs", "types", "checks", "threads", "commands", "train", "bench", "preprocess"}

# The same within the three largest packages: a folder or module may import itself and what its entry names.
# Modules without an entry put the folders together and may import all of them.
ROOMS: dict[str, dict[str, set[str]]] = {
    "preprocess": {
        "stamps": set(),
        "artefacts": {"stamps"},
        "frames": {"stamps", "artefacts"},
        "hands": {"stamps", "artefacts", "frames"},
        "masks": {"stamps", "artefacts", "frames", "hands"},
        "object": {"stamps", "artefacts", "frames"},
    },
    "train": {
        "plan": set(),
        "start": {"plan"},
        "grasps": {"plan"},
        "loop": {"plan", "start", "grasps"},
        "moves": {"plan", "grasps", "loop"},
        "unseen": {"plan", "start", "loop"},
    },
    "commands": {
        "clips": set(),
        "preprocess": set(),
        "folder": {"clips"},
        "prior": {"clips"},
        "export": {"folder"},
        "render": {"clips", "folder", "export"},
        "evaluate": {"clips", "folder", "render"},
        "run": {"clips", "folder", "prior", "export", "render", "evaluate"},
        "batch": {"clips", "folder", "run"},
        "bench": {"clips", "preprocess", "folder", "evaluate", "run"},
    },
}

# Single edges that the table does not allow: the importing module, what it imports.
EXCEPTIONS = {("losses.photometric", "metrics.image")}  # so that SSIM exists once


class Import(NamedTuple):
    """`module` (without "bigs.") imports `target` (without "bigs."; "bigs" for the package itself)."""

    module: str
    target: str
    place: str


def sources() -> list[Path]:
    return sorted([*ROOT.rglob("*.py"), *ROOT.rglob("*.pyi")])


def name_of(path: Path) -> str:
    parts = list(path.relative_to(ROOT).with_suffix("").parts)
    if parts[-1] == "__init__":
        parts.pop()
    return ".".join(parts) or "bigs"


def absolute(node: ast.ImportFrom, path: Path) -> str:
    """The full name of the module that `from ... import` names, relative or not."""
    if node.level == 0:
        return node.module or ""
    package = ("bigs", *path.relative_to(ROOT).parts[:-1])
    base = package[: len(package) - node.level + 1]
    return ".".join((*base, *([node.module] if node.module else [])))


def imports_of(path: Path, tree: ast.AST) -> Iterator[Import]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            source = absolute(node, path)
            # `from bigs import hand` is an import of bigs.hand.
            names = [f"bigs.{a.name}" for a in node.names] if source == "bigs" else [source]
        else:
            continue
        for name in names:
            if name == "bigs" or name.startswith("bigs."):
                target = name.removeprefix("bigs.")
                known = (ROOT / target.split(".")[0]).is_dir() or target.split(".")[0] in MAY_IMPORT
                yield Import(
                    name_of(path),
                    target if known else "bigs",
                    f"{path.relative_to(ROOT.parent)}:{node.lineno}",
                )


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


@cache
def all_imports() -> list[Import]:
    return [found for path in sources() for found in imports_of(path, tree_of(path))]


def offence(found: Import) -> str | None:
    """One line that names the edge, or None if it is allowed."""
    part, other = found.module.split(".")[0], found.target.split(".")[0]
    if part == other or (found.module, found.target) in EXCEPTIONS or other in MAY_IMPORT[part]:
        return None
    return f"{found.place}: bigs.{found.module} imports {found.target}, but {part} may not see {other}"


def offence_within(found: Import) -> str | None:
    """One line that names an edge within a package that does not point down, or None."""
    package, room, *_ = [*found.module.split("."), ""]
    other, part, *_ = [*found.target.split("."), ""]
    below = ROOMS.get(package, {}).get(room)
    if below is None or other != package or part in below | {room}:
        return None
    return f"{found.place}: bigs.{found.module} imports {found.target}, which {package}.{room} may not see"


def test_every_part_is_in_the_table() -> None:
    parts = {name_of(path).split(".")[0] for path in sources()}
    assert parts == set(MAY_IMPORT), f"not in both: {sorted(parts ^ set(MAY_IMPORT))}"


def test_the_table_has_no_cycles() -> None:
    below: set[str] = {"_raster"}  # the stub's edge back to the settings is no import at run time
    waiting = dict(MAY_IMPORT)
    while ready := [part for part, needs in waiting.items() if needs <= below]:
        below |= set(ready)
        for part in ready:
            del waiting[part]
    assert not waiting, f"parts that wait for each other: {sorted(waiting)}"


def test_imports_only_point_down() -> None:
    offences = [line for found in all_imports() if (line := offence(found))]
    assert not offences, "\n" + "\n".join(offences)


def test_folders_of_a_package_only_point_down() -> None:
    for package, rooms in ROOMS.items():
        assert {path.parent.name for path in (ROOT / package).glob("*/__init__.py")} <= set(rooms)
        known: set[str] = set()
        # Entries stand in an order in which each sees earlier ones only.
        for room, below in rooms.items():
            assert below <= known, f"{package}.{room}: {sorted(below - known)} come later"
            known.add(room)
    offences = [line for found in all_imports() if (line := offence_within(found))]
    assert not offences, "\n" + "\n".join(offences)


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("train/plan/config.py", "from bigs.train.loop.density import Pull"),
        ("train/start/build.py", "from bigs.train.fit import fit"),
        ("train/loop/step.py", "import bigs.train.unseen.stages"),
        ("preprocess/frames/camera.py", "from bigs.preprocess.masks.clicks import read_clicks"),
        ("commands/folder/log.py", "from ..run.series import PlannedRun"),
    ],
)
def test_forbidden_edges_within_a_package_are_found(module: str, line: str) -> None:
    (found,) = imports_of(ROOT / module, ast.parse(line))
    assert offence_within(found) is not None


def test_exceptions_are_still_needed() -> None:
    edges = {(found.module, found.target) for found in all_imports()}
    assert edges >= EXCEPTIONS, f"no longer there: {sorted(EXCEPTIONS - edges)}"


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("losses/mask.py", "from bigs.models.scene import Scene"),
        ("losses/mask.py", "from bigs.metrics.image import ssim"),
        ("viewer/plot.py", "from bigs.geometry import mesh"),
        ("data/base.py", "def f():\n    import bigs.hand.model"),
        ("geometry/mesh.py", "if TYPE_CHECKING:\n    from bigs.hand import HandModel"),
        ("hand/lbs.py", "from ..fields import Triplane"),
        ("models/scene.py", "from bigs import raster"),
        ("types.py", "from .checks import InputError"),
    ],
)
def test_forbidden_edges_are_found_however_they_are_written(module: str, line: str) -> None:
    (found,) = imports_of(ROOT / module, ast.parse(line))
    assert offence(found) is not None


def test_only_the_command_line_prints_or_exits() -> None:
    offences = []
    for path in sources():
        if name_of(path).split(".")[0] == "cli":
            continue
        file = path.relative_to(ROOT.parent)
        for node in ast.walk(tree_of(path)):
            place = f"{file}:{getattr(node, 'lineno', 0)}"
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                if node.func.id in ("print", "exit", "quit", "input"):
                    offences.append(f"{place}: calls {node.func.id}()")
            elif isinstance(node, ast.Import) and "sys" in {alias.name for alias in node.names}:
                offences.append(f"{place}: imports sys")
            elif isinstance(node, ast.ImportFrom) and node.module == "sys":
                offences.append(f"{place}: imports from sys")
            elif isinstance(node, ast.Name) and node.id == "SystemExit":
                offences.append(f"{place}: uses SystemExit")
            elif isinstance(node, ast.Attribute) and node.attr == "_exit":
                offences.append(f"{place}: uses _exit")
    assert not offences, "\n" + "\n".join(offences)

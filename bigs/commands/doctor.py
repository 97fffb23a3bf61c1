"""What is installed on this machine, what is missing, and what that would enable."""

from __future__ import annotations

import importlib
import importlib.util
import os
import platform
import shutil
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from typing import Literal, NamedTuple

import torch

import bigs

State = Literal["ok", "missing", "broken", "note"]


class Finding(NamedTuple):
    """One line of the report."""

    name: str
    state: State
    detail: str


class Extra(NamedTuple):
    """An optional part: the modules that it needs, and what they are for."""

    modules: tuple[str, ...]
    enables: str


# Modules of the packages that pyproject.toml requires; a test compares them.
REQUIRED = (
    *("numpy", "torch", "kornia", "trimesh", "pycolmap", "scipy", "rtree"),
    *("skimage", "PIL", "safetensors", "tyro", "rich", "yaml"),
)
# The extras of pyproject.toml; a test compares them.
EXTRAS: dict[str, Extra] = {
    "video": Extra(("av",), "preview.mp4, and videos as input of bigs preprocess"),
    "synthetic": Extra(("embreex",), "bigs demo and every generated clip"),
    "bench": Extra(("matplotlib",), "the pictures of bigs bench"),
    "diffusion": Extra(("diffusers", "transformers", "accelerate"), "Stable Diffusion as the object's prior"),
    "segment": Extra(("transformers",), "masks from clicks with SAM 2 in bigs preprocess"),
    "viewer": Extra(("viser",), "bigs view"),
    "export": Extra(("gsply",), "bigs export --format spz"),
    "rerun": Extra(("rerun",), "bigs export --format rerun"),
    "slurm": Extra(("submitit",), "bigs batch --engine slurm"),
    "ray": Extra(("ray",), "bigs batch --engine ray"),
    "browser": Extra(("playwright",), "the tests of the viewer and the report in a browser"),
    "dev": Extra(("maturin", "pytest", "xdist", "hypothesis"), "building and testing bigs itself"),
}
# Environment variables that name data, and their use.
VARIABLES = {
    "BIGS_BENCH": "other workloads for bigs bench engine",
    "BIGS_CLIPS": "real clips for the tests",
    "BIGS_HAND_MODEL": "hand models for the tests",
}
# Distribution of a module, if its name differs.
DISTRIBUTIONS = {
    "skimage": "scikit-image",
    "PIL": "pillow",
    "yaml": "pyyaml",
    "rerun": "rerun-sdk",
    "xdist": "pytest-xdist",
}


def examine() -> list[tuple[str, list[Finding]]]:
    """Look at the machine, the packages and the data that environment variables name: headed groups."""
    return [
        ("machine", list(_machine())),
        ("packages", [_package(name) for name in REQUIRED]),
        ("extras", [_extra(name, extra) for name, extra in EXTRAS.items()]),
        ("programs and data", list(_outside())),
    ]


def _machine() -> Iterator[Finding]:
    yield Finding("bigs", "ok", bigs.__version__)
    yield Finding("python", "ok", f"{platform.python_version()} on {platform.system()} {platform.machine()}")
    yield Finding("torch", "ok", f"{torch.__version__}, {torch.get_num_threads()} threads")
    try:
        from bigs.bench.machine import machine_facts
    except ImportError as error:
        yield Finding("engine", "broken", f"not built for this machine ({error}); nothing can be rendered")
        return
    level = machine_facts()["level"]
    forced = " (BIGS_RASTER_SIMD holds it there)" if os.environ.get("BIGS_RASTER_SIMD") else ""
    threads = os.environ.get("RAYON_NUM_THREADS") or f"{os.cpu_count()} (all)"
    yield Finding("engine", "ok", f"CPU instructions {level}{forced}, {threads} threads")
    if torch.cuda.is_available():
        with_gsplat = importlib.util.find_spec("gsplat") is not None
        words = "used" if with_gsplat else "unused: needs gsplat"
        yield Finding("GPU", "ok" if with_gsplat else "note", f"{torch.cuda.get_device_name()}, {words}")
    else:
        yield Finding("GPU", "note", "none, and none is needed")


def _package(module: str) -> Finding:
    name = DISTRIBUTIONS.get(module, module)
    try:
        importlib.import_module(module)
    except ImportError as error:
        return Finding(name, "broken", f"bigs needs it: {error}")
    return Finding(name, "ok", _version(name))


def _extra(name: str, extra: Extra) -> Finding:
    missing = [module for module in extra.modules if importlib.util.find_spec(module) is None]
    if missing:
        return Finding(name, "missing", f"pip install 'bigs[{name}]' would enable {extra.enables}")
    found = (DISTRIBUTIONS.get(module, module) for module in extra.modules)
    return Finding(name, "ok", f"{', '.join(f'{n} {_version(n)}' for n in found)}: {extra.enables}")


def _outside() -> Iterator[Finding]:
    if importlib.util.find_spec("torchvision") is not None:
        try:
            importlib.import_module("torchvision")
        except Exception as error:  # its binary part may raise anything
            yield Finding(
                "torchvision",
                "broken",
                f"installed for another torch, which breaks the extra diffusion; remove it ({error})",
            )
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        yield Finding("Chromium", "missing", "the tests of the viewer in a browser are skipped without it")
    else:
        yield Finding("Chromium", "ok", browser)
    for variable, enables in VARIABLES.items():
        value = os.environ.get(variable)
        if not value:
            yield Finding(variable, "note", f"not set; {enables}")
        elif not os.path.exists(value):
            yield Finding(variable, "broken", f"names {value}, which is not there; {enables}")
        else:
            yield Finding(variable, "ok", value)
    yield Finding(
        "hand model",
        "note",
        "the built-in hand needs no file; MANO_RIGHT and MANO_LEFT (.pkl or .npz) from mano.is.tue.mpg.de, "
        "under its licence, are given with --hand-model",
    )


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "of unknown version"

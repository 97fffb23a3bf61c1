"""Four kinds of scene that a splatting engine meets, made from a seed."""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np

from bigs.checks import InputError, check_choice

# Names of the differentiable arrays in the renderers' order.
PARAMETERS = ("means", "quats", "scales", "opacities", "colors")

# A folder with a `workloads.py` whose make_workload(name) replaces the generators below.
FOLDER_VARIABLE = "BIGS_BENCH"

_SMALLEST_IMAGE = 16
_FEWEST_GAUSSIANS = 40


@dataclass(frozen=True)
class WorkloadSpec:
    """What makes a workload: the same spec gives the same numbers in any process."""

    name: str  # one of KINDS
    seed: int = 0
    scale: float = 1.0  # factor on the number of Gaussians and of pixels
    folder: str | None = None  # folder with its own workloads, which ignore seed and scale


@dataclass(frozen=True)
class Workload:
    """Gaussians, one camera, and the incoming gradient of the image."""

    gaussians: dict[
        str, np.ndarray
    ]  # means [N, 3] m, quats [N, 4], scales [N, 3] m, opacities [N], colors [N, 3]
    viewmat: np.ndarray  # [4, 4] world to camera
    K: np.ndarray  # [3, 3]
    width: int
    height: int
    weights: np.ndarray  # [H, W, 3]: the loss is sum(image · weights)


@dataclass(frozen=True)
class Kind:
    """One kind of workload at scale 1."""

    text: str
    gaussians: int
    size: int  # side of the square image, pixels
    make: Callable[[np.random.Generator, int, int], dict[str, np.ndarray]]


def from_environment() -> str | None:
    """The folder that BIGS_BENCH names.

    Raises:
        InputError: it holds no workloads.
    """
    folder = os.environ.get(FOLDER_VARIABLE)
    if folder and not (Path(folder) / "workloads.py").is_file():
        raise InputError(f"{FOLDER_VARIABLE}: expected a folder with workloads.py, found {folder}")
    return folder or None


@cache
def folder_module(folder: str) -> ModuleType:
    """The folder's `workloads.py`, loaded by path."""
    spec = importlib.util.spec_from_file_location("bench_workloads", Path(folder) / "workloads.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make_workload(spec: WorkloadSpec) -> Workload:
    """The workload of a spec, float32.

    Raises:
        InputError: no such kind.
    """
    check_choice("workload", spec.name, KINDS)
    if spec.folder is not None:
        made = folder_module(spec.folder).make_workload(spec.name)
        gaussians = {name: made[name] for name in PARAMETERS}
        return Workload(
            gaussians, made["viewmat"], made["K"], int(made["width"]), int(made["height"]), made["weights"]
        )
    kind = KINDS[spec.name]
    n = max(_FEWEST_GAUSSIANS, round(kind.gaussians * spec.scale))
    size = max(_SMALLEST_IMAGE, round(kind.size * math.sqrt(spec.scale)))
    random = np.random.default_rng([spec.seed, *spec.name.encode()])
    gaussians = kind.make(random, n, size)
    order = random.permutation(n)  # the order says nothing about positions
    gaussians = {name: np.ascontiguousarray(gaussians[name][order], np.float32) for name in PARAMETERS}
    focal = 1.2 * size
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], np.float32)
    return Workload(gaussians, np.eye(4, dtype=np.float32), K, size, size, _weights(random, size))


def _weights(random: np.random.Generator, size: int) -> np.ndarray:
    """An incoming gradient with a smooth and a rough part, as losses on images have; [size, size, 3]."""
    phase = np.linspace(0, 2 * math.pi, size, endpoint=False)
    smooth = [np.add.outer(np.sin((c + 1) * phase), np.cos((3 - c) * phase)) for c in range(3)]
    return (0.3 * np.stack(smooth, axis=-1) + random.uniform(-1, 1, (size, size, 3))).astype(np.float32)


def _directions(random: np.random.Generator, n: int) -> np.ndarray:
    """Uniform on the sphere; [n, 3]."""
    vectors = random.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _quats_of_normals(random: np.random.Generator, normals: np.ndarray) -> np.ndarray:
    """Rotations w x y z that take the z axis to a normal, spun about it by any angle; [n, 4]."""
    half = random.uniform(0, math.pi, len(normals))
    spin = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
    # The shortest arc from z: (1 + n·z, z × n). Where n is -z that is zero, so half a turn about x is used.
    x, y, z = normals.T
    arc = np.stack([1 + z, -y, x, 0 * z], axis=-1)
    arc[np.linalg.norm(arc, axis=-1) < 1e-6] = (0, 1, 0, 0)
    arc /= np.linalg.norm(arc, axis=-1, keepdims=True)
    (aw, ax, ay, az), (bw, bx, by, bz) = arc.T, spin.T
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def _hand_and_object(random: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and colours [n, 3] on a can with a palm beside and five fingers before it."""
    can, palm = n // 2, n // 5
    angle, height = random.uniform(0, 2 * math.pi, can), random.uniform(-0.07, 0.07, can)
    normals = [np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=-1)]
    points = [0.035 * normals[0] + np.stack([0 * height, height, 0 * height], axis=-1)]
    stripes = 0.5 + 0.5 * np.sign(np.sin(9 * angle) * np.sin(height / 0.008))
    colors = [np.stack([0.9 - 0.6 * stripes, 0.2 + 0.3 * stripes, 0.25 + 0.5 * stripes], axis=-1)]

    # The palm and the fingers are ellipsoids: centre and half axes in metres.
    parts = [(palm, (0.06, 0.0, 0.0), (0.015, 0.05, 0.04))]
    left = n - can - palm
    for k in range(5):
        count = left // 5 if k < 4 else left - 4 * (left // 5)
        parts.append((count, (0.0, -0.045 + 0.022 * k, -0.045), (0.04, 0.009, 0.011)))
    for count, centre, axes in parts:
        directions = _directions(random, count)
        points.append(directions * axes + centre)
        outward = directions / axes
        normals.append(outward / np.linalg.norm(outward, axis=-1, keepdims=True))
        shade = 0.8 + 0.2 * directions[:, 1:2] + 0.04 * random.normal(size=(count, 1))
        colors.append(np.clip(shade * (0.87, 0.67, 0.56), 0, 1))
    away = np.array([0.0, 0.0, 0.45])
    return np.concatenate(points) + away, np.concatenate(normals), np.concatenate(colors)


def _isotropic_hand_and_object(random: np.random.Generator, n: int, size: int) -> dict[str, np.ndarray]:
    points, _, colors = _hand_and_object(random, n)
    return {
        "means": points,
        "quats": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)) + 0.3 * random.normal(size=(n, 4)),
        "scales": np.repeat(0.002 * np.exp(0.1 * random.normal(size=(n, 1))), 3, axis=1),
        "opacities": random.uniform(0.5, 1.0, n),
        "colors": colors,
    }


def _flat_hand_and_object(random: np.random.Generator, n: int, size: int) -> dict[str, np.ndarray]:
    points, normals, colors = _hand_and_object(random, n)
    return {
        "means": points,
        "quats": _quats_of_normals(random, normals),
        "scales": np.array([0.0015, 0.0009, 0.0002]) * np.exp(0.3 * random.normal(size=(n, 3))),
        "opacities": random.uniform(0.5, 1.0, n),
        "colors": colors,
    }


def _in_the_frustum(random: np.random.Generator, n: int, near: float, far: float) -> np.ndarray:
    """Points seen by the camera, or up to 15 % outside its image, at depths between near and far; [n, 3]."""
    z = random.uniform(near, far, (n, 1))
    slope = 1.15 * 0.5 / 1.2
    return np.concatenate([random.uniform(-slope, slope, (n, 2)) * z, z], axis=1)


def _dense_scene(random: np.random.Generator, n: int, size: int) -> dict[str, np.ndarray]:
    return {
        "means": _in_the_frustum(random, n, 1.0, 6.0),
        "quats": random.normal(size=(n, 4)),
        # Smaller images have larger pixels; the footprints keep their size in pixels.
        "scales": 0.006 * (800 / size) * np.exp(0.6 * random.normal(size=(n, 3))),
        "opacities": 1 / (1 + np.exp(-1.5 * random.normal(size=n))),
        "colors": random.uniform(0, 1, (n, 3)),
    }


def _faint_pile(random: np.random.Generator, n: int, size: int) -> dict[str, np.ndarray]:
    return {
        "means": _in_the_frustum(random, n, 1.0, 2.0),
        "quats": np.array([1.0, 0.0, 0.0, 0.0]) + 0.25 * random.normal(size=(n, 4)),
        "scales": random.uniform(0.08, 0.3, (n, 3)) * (1.0, 1.0, 0.2),
        "opacities": random.uniform(0.01, 0.06, n),
        "colors": random.uniform(0, 1, (n, 3)),
    }


KINDS: dict[str, Kind] = {
    "A": Kind("hand and object, isotropic", 10_000, 256, _isotropic_hand_and_object),
    "B": Kind("hand and object, flat on the surface", 50_000, 512, _flat_hand_and_object),
    "C": Kind("dense random scene", 200_000, 800, _dense_scene),
    "D": Kind("pile of large faint Gaussians", 5_000, 128, _faint_pile),
}

"""Hostile scenes: ordinary Gaussians around a few that no renderer likes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from raster_scenes import scene

from bigs.raster import RasterSettings


class Hostile(NamedTuple):
    """A scene, its rules, and how far single precision may be from the truth (relative L2)."""

    build: Callable[[], dict[str, Any]]
    settings: RasterSettings = RasterSettings()
    image: float = 3e-6
    gradient: float = 1e-4
    touchy: bool = False
    """Half a bit of the inputs moves the picture by more than that: this is what bounds the error instead."""


# Every eighth Gaussian of a scene is the hostile kind, so that occlusion runs both ways.
def odd_ones(inputs: dict[str, Any]) -> torch.Tensor:
    return torch.arange(len(inputs["means"]))[3::8]


def base(**options: Any) -> dict[str, Any]:
    """Gaussians whose numbers are exact in float32, as float64."""
    inputs = scene(**{"n": 48, "width": 45, "height": 38, "seed": 5, **options})
    return rounded(inputs)


def rounded(inputs: dict[str, Any]) -> dict[str, Any]:
    return {k: v.float().double() if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}


def with_odd(name: str, *values: Any, **options: Any) -> Callable[[], dict[str, Any]]:
    """The base scene where the odd ones have one input replaced, by the given values in turn."""

    def build() -> dict[str, Any]:
        inputs = base(**options)
        for turn, i in enumerate(odd_ones(inputs)):
            inputs[name][i] = torch.tensor(values[turn % len(values)], dtype=torch.float64)
        return rounded(inputs)

    return build


def at_depths(*depths: float) -> Callable[[], dict[str, Any]]:
    """The odd ones stand at these camera depths, all before an unturned camera."""

    def build() -> dict[str, Any]:
        inputs = base()
        inputs["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
        for turn, i in enumerate(odd_ones(inputs)):
            z = depths[turn % len(depths)]
            inputs["means"][i] = torch.tensor([0.1 * abs(z), -0.05 * abs(z), z])
            inputs["scales"][i] *= max(abs(z), 1e-3)
            inputs["opacities"][i] = 0.4
        return rounded(inputs)

    return build


def needles(length: float, ratio: float, off_screen: bool = False) -> Callable[[], dict[str, Any]]:
    def build() -> dict[str, Any]:
        inputs = base(seed=6)
        odd = odd_ones(inputs)
        inputs["scales"][odd] = torch.tensor([length, length / ratio, length / ratio], dtype=torch.float64)
        # Along the view, along each image axis, and every which way.
        inputs["quats"][odd[0]] = torch.tensor([1.0, 0.0, 1.0, 0.0])
        inputs["quats"][odd[1]] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        inputs["quats"][odd[2]] = torch.tensor([1.0, 0.0, 0.0, 1.0])
        if off_screen:
            inputs["means"][odd, 0] += 2.0
        return rounded(inputs)

    return build


def discs(width: float, thickness: float) -> Callable[[], dict[str, Any]]:
    def build() -> dict[str, Any]:
        inputs = base(seed=7)
        inputs["scales"][odd_ones(inputs)] = torch.tensor([width, width, thickness], dtype=torch.float64)
        return rounded(inputs)

    return build


def focal(length: float) -> Callable[[], dict[str, Any]]:
    """The same picture through a lens of this many pixels, so that the scene is that much flatter."""

    def build() -> dict[str, Any]:
        inputs = base()
        zoom = length / inputs["Ks"][0, 0, 0]
        inputs["Ks"][:, [0, 1], [0, 1]] *= zoom
        inputs["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
        inputs["means"][:, :2] /= zoom
        inputs["scales"] /= max(zoom, 1.0)
        return rounded(inputs)

    return build


def principal_point(x: float, y: float) -> Callable[[], dict[str, Any]]:
    """The image is a window far from where the camera looks; the Gaussians are moved there."""

    def build() -> dict[str, Any]:
        inputs = base()
        inputs["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
        z = inputs["means"][:, 2]
        for axis, shift in enumerate((x, y)):
            inputs["means"][:, axis] += shift / inputs["Ks"][0, axis, axis] * z
            inputs["Ks"][:, axis, 2] -= shift
        return rounded(inputs)

    return build


def image_of(width: int, height: int, n: int = 80) -> Callable[[], dict[str, Any]]:
    def build() -> dict[str, Any]:
        inputs = base(n=n, width=width, height=height)
        narrow = min(width, height)
        inputs["Ks"][:, [0, 1], [0, 1]] = 3.0 * narrow
        # Spread over the long side.
        wide = 0.5 * max(width, height) / (3.0 * narrow)
        axis = int(height > width)
        place = torch.linspace(-wide, wide, n, dtype=torch.float64)
        inputs["means"][:, axis] = place * inputs["means"][:, 2]
        return rounded(inputs)

    return build


def far_from_origin(offset: float, turned: bool) -> Callable[[], dict[str, Any]]:
    """World coordinates of `offset` metres, and a camera there."""

    def build() -> dict[str, Any]:
        inputs = base()
        shift = torch.tensor([offset, -0.5 * offset, 0.25 * offset], dtype=torch.float64)
        if not turned:
            inputs["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
        inputs = rounded({**inputs, "means": inputs["means"] + shift})
        rotation = inputs["viewmats"][0, :3, :3]
        inputs["viewmats"][0, :3, 3] -= rotation @ shift
        return rounded(inputs)

    return build


def camera_matrix(linear: list[list[float]], grow: float = 1.0) -> Callable[[], dict[str, Any]]:
    """The base scene, `grow` times as large, seen through a camera whose 3×3 part is no rotation."""

    def build() -> dict[str, Any]:
        inputs = base()
        inputs["viewmats"][0, :3, :3] = torch.tensor(linear, dtype=torch.float64)
        inputs["viewmats"][0, :3, 3] = torch.tensor([0.02, -0.03, 0.1])
        inputs["means"] *= grow
        inputs["scales"] *= grow
        return rounded(inputs)

    return build


def whole_scene(factor: float) -> Callable[[], dict[str, Any]]:
    """Scene and camera in other units."""

    def build() -> dict[str, Any]:
        inputs = base()
        inputs["means"] *= factor
        inputs["scales"] *= factor
        inputs["viewmats"][:, :3, 3] *= factor
        return rounded(inputs)

    return build


def coincident() -> dict[str, Any]:
    inputs = base(n=4000, width=20, height=18)
    for name in ("means", "quats", "scales"):
        inputs[name][1:] = inputs[name][:1].clone()
    inputs["means"][:] = torch.tensor([0.01, 0.02, 1.0])
    inputs["scales"][:] = torch.tensor([0.2, 0.1, 0.05])
    inputs["opacities"] *= 0.02
    inputs["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    return rounded(inputs)


def equal_depths() -> dict[str, Any]:
    inputs = base(n=300)
    inputs["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    inputs["means"][:, 2] = 1.25
    return rounded(inputs)


def layers() -> dict[str, Any]:
    """100,000 layers over four pixels: transmittance leaves every range of numbers."""
    inputs = base(n=100_000, width=2, height=2)
    inputs["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    inputs["means"][:, :2] *= 0.01
    inputs["means"][:, 2] = 1.0 + torch.arange(100_000, dtype=torch.float64) / 65536.0
    inputs["scales"] += 2.0
    inputs["opacities"] *= 0.03
    return rounded(inputs)


NO_STOP = RasterSettings(min_transmittance=0.0)
# Every pair counts, so no rounding moves one over a threshold.
SOFT = RasterSettings(alpha_threshold=1e-7, min_transmittance=0.0)
SOFT_ANTIALIASED = RasterSettings(alpha_threshold=1e-7, min_transmittance=0.0, antialiased=True)
THRESHOLD = 1.0 / 255.0

HOSTILE: dict[str, Hostile] = {
    "scales 0": Hostile(with_odd("scales", [0.0, 0.0, 0.0], [0.1, 0.0, 0.1], [0.0, 0.1, 0.0])),
    "scales 1e-41": Hostile(with_odd("scales", [1e-41] * 3, [1e-41, 0.1, 0.1])),
    "scales 1e-12": Hostile(with_odd("scales", [1e-12] * 3, [1e-12, 0.1, 0.1])),
    "scales 1e3": Hostile(with_odd("scales", [1e3] * 3, [1e3, 0.1, 10.0]), SOFT),
    "scales 1e4, antialiased": Hostile(
        with_odd("scales", [1e4] * 3, [1e4, 3e3, 3e3], [5e3, 9e3, 1.0]), SOFT_ANTIALIASED
    ),
    "scales 1e6": Hostile(with_odd("scales", [1e6] * 3, [1e6, 0.1, 10.0]), SOFT),
    "scales 1e12": Hostile(with_odd("scales", [1e12] * 3, [1e12, 0.1, 10.0]), SOFT),
    "scales 1e30": Hostile(with_odd("scales", [1e30] * 3, [1e30, 1e30, 1e20]), SOFT),
    "negative scales": Hostile(with_odd("scales", [-0.1, 0.1, 0.05], [-0.05, -0.2, -0.1])),
    "needles 1 m : 1e-6": Hostile(needles(1.0, 1e6), SOFT),
    "needles 1 km : 1e-6": Hostile(needles(1e3, 1e6), SOFT),
    "needles 1 m : 1e-6, off screen": Hostile(needles(1.0, 1e6, True), SOFT),
    "discs 10 m : 1e-6": Hostile(discs(10.0, 1e-5), SOFT),
    "needles without blur": Hostile(needles(1.0, 1e3), RasterSettings(eps2d=0.0)),
    "quaternions 0": Hostile(with_odd("quats", [0.0] * 4)),
    "quaternions 1e-20": Hostile(with_odd("quats", [1e-20, 2e-20, -1e-20, 3e-20], [0.0, 1e-20, 0.0, 0.0])),
    "quaternions 1e20": Hostile(with_odd("quats", [1e20, 2e20, -1e20, 3e20], [1e20, 0.0, 1e20, 0.0])),
    "quaternions 1e-41 and 1e38": Hostile(
        with_odd("quats", [1e38, -1e38, 1e38, 1e38], [1e38, 1e-38, 0.0, 1e38])
    ),
    "at the near plane": Hostile(at_depths(0.01, math.nextafter(0.01, 1), 0.010001, 0.0100001)),
    "behind and at the camera": Hostile(at_depths(-1.0, 0.0, -1e-30, -0.01)),
    "near plane 1e-6": Hostile(at_depths(1e-5, 2e-6, 1e-4), RasterSettings(near_plane=1e-6)),
    "near plane 1e-20": Hostile(at_depths(1e-10, 1e-15, 1e-19), RasterSettings(near_plane=1e-20)),
    "opacity 0 and below": Hostile(with_odd("opacities", 0.0, -0.5, -1e30, -0.0)),
    "opacity 1 and beyond": Hostile(with_odd("opacities", 1.0, 1.5, 20.0, 1e30)),
    "opacity at the threshold": Hostile(
        with_odd("opacities", THRESHOLD, THRESHOLD * 1.001, THRESHOLD * 0.999)
    ),
    "4,000 coincident": Hostile(coincident),
    "equal depths": Hostile(equal_depths),
    "100,000 layers, stopped": Hostile(layers),
    "100,000 layers, no stop": Hostile(layers, NO_STOP),
    "focal length 1": Hostile(focal(1.0)),
    "focal length 1e4": Hostile(focal(1e4)),
    "focal length 1e6": Hostile(focal(1e6)),
    "principal point at -1e4": Hostile(principal_point(1e4, -5e3), SOFT, touchy=True),
    "principal point at 1e6": Hostile(principal_point(-1e6, 1e6), SOFT, touchy=True),
    "image 1 × 1": Hostile(image_of(1, 1)),
    "image 7919 × 3": Hostile(image_of(7919, 3), SOFT, touchy=True),
    "image 3 × 7919": Hostile(image_of(3, 7919), SOFT, touchy=True),
    "one Gaussian": Hostile(lambda: base(n=1)),
    "1e6 m from the origin": Hostile(far_from_origin(1e6, False)),
    "1e6 m from the origin, turned": Hostile(far_from_origin(1e6, True), SOFT, touchy=True),
    "1e4 m from the origin, turned": Hostile(far_from_origin(1e4, True), SOFT, touchy=True),
    "camera scaled by 1e-3": Hostile(camera_matrix([[1e-3, 0, 0], [0, 1e-3, 0], [0, 0, 1e-3]], 1e3)),
    "camera scaled by 1e6": Hostile(camera_matrix([[1e6, 0, 0], [0, 1e6, 0], [0, 0, 1e6]], 1e-6)),
    "camera sheared": Hostile(camera_matrix([[1, 0.7, 0.2], [0, 1, -0.3], [0.1, 0.4, 1]])),
    "camera mirrored": Hostile(camera_matrix([[-1, 0, 0], [0, 1, 0], [0, 0, 1]])),
    "camera squeezed": Hostile(camera_matrix([[1, 0, 0], [0, 1e-4, 0], [0, 0, 1]])),
    "units 1e-6": Hostile(whole_scene(1e-6), RasterSettings(near_plane=1e-8)),
    "units 1e6": Hostile(whole_scene(1e6)),
}

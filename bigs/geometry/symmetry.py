"""Symmetries of an object of which one side was seen: mirror planes and axes of revolution.

A symmetry carries what was seen to other places. There it may meet seen surface of the same kind (support),
fall where the clip shows that nothing is (contradiction), or fall where nobody looked. After Thrun and
Wegbreit, "Shape from symmetry" (2005): the last are no evidence against it, and what it fills.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.optimize
import scipy.spatial

from bigs.geometry.coverage import sphere_directions


@dataclass(frozen=True)
class SymmetryConfig:
    """When a symmetry counts as found. Lengths are shares of the object's longest side."""

    # A carried point meets seen surface when it is as near as this, with a normal within 35 degrees.
    tolerance: float = 0.02
    # Share of the carried points that must meet seen surface, and that may contradict the clip.
    least_support: float = 0.35
    most_contradiction: float = 0.03
    # The colours that meet must be nearer to each other than this share of what chance would make them.
    most_color_error: float = 0.85
    # How much worse, in support less contradictions, a shift by 1.5 tolerances or a turn by 5 degrees must be.
    least_sharpness: float = 0.03


@dataclass(frozen=True)
class SeenSurface:
    """Evenly spread samples of what a clip has seen of an object."""

    points: np.ndarray  # [N, 3] metres
    normals: np.ndarray  # [N, 3] unit, outward
    colors: np.ndarray  # [N, 3] in [0, 1]


# Which of the points [N, 3] lie where the clip shows that there is no object.
IsEmpty = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Symmetry:
    """A mirror plane, or an axis about which any turn leaves the object the same."""

    kind: Literal["plane", "axis"]
    point: np.ndarray  # [3] on the plane or axis, metres
    direction: np.ndarray  # [3] unit: the plane's normal, the axis's direction
    support: float = 0.0
    contradiction: float = 0.0

    def images(self, surface: SeenSurface) -> list[SeenSurface]:
        """The surface carried by the symmetry: one copy, or eleven turned by 30 degrees each."""
        if self.kind == "plane":
            matrices = [np.eye(3) - 2.0 * np.outer(self.direction, self.direction)]
        else:
            angles = np.arange(1, _TURNS) * (2.0 * np.pi / _TURNS)
            turns = scipy.spatial.transform.Rotation.from_rotvec(angles[:, None] * self.direction)
            matrices = list(turns.as_matrix())
        return [
            SeenSurface(
                (surface.points - self.point) @ matrix.T + self.point,
                surface.normals @ matrix.T,
                surface.colors,
            )
            for matrix in matrices
        ]


_TURNS = 12
# Candidates that are refined, and how often; samples that vote.
_FINALISTS = 12
_ROUNDS = 12
_VOTERS = 400
_LEAST_COSINE = 0.82


class _Judge:
    """Scores symmetries against what was seen."""

    def __init__(self, surface: SeenSurface, is_empty: IsEmpty, config: SymmetryConfig) -> None:
        self.surface = surface
        self.is_empty = is_empty
        self.config = config
        self.size = float(np.ptp(surface.points, axis=0).max())
        self.tolerance = config.tolerance * self.size
        self.tree = scipy.spatial.cKDTree(surface.points)
        middle = np.median(surface.colors, axis=0)
        # Of two colours drawn at random from the surface; never so small that noise decides.
        self.chance = max(float(np.abs(surface.colors - middle).mean()) * 1.4, 0.02)

    def matches(self, image: SeenSurface, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """Which carried points [M] (indices) meet seen surface within `reach`, and the indices they meet."""
        distance, index = self.tree.query(image.points, distance_upper_bound=reach)
        near = np.flatnonzero(np.isfinite(distance))
        same_way = (image.normals[near] * self.surface.normals[index[near]]).sum(-1) > _LEAST_COSINE
        return near[same_way], index[near[same_way]]

    def score(self, symmetry: Symmetry) -> tuple[float, float, float]:
        """Support, contradiction, and colour error relative to chance."""
        support, contradiction, errors = [], [], []
        for image in symmetry.images(self.surface):
            carried, met = self.matches(image, self.tolerance)
            support.append(len(carried) / len(image.points))
            rest = np.ones(len(image.points), dtype=bool)
            rest[carried] = False
            contradiction.append(self.is_empty(image.points[rest]).sum() / len(image.points))
            errors.append(np.abs(image.colors[carried] - self.surface.colors[met]).mean(-1))
        error = np.concatenate(errors)
        color = float(error.mean()) / self.chance if len(error) else np.inf
        return float(np.mean(support)), float(np.mean(contradiction)), color

    def worth(self, symmetry: Symmetry) -> float:
        support, contradiction, _ = self.score(symmetry)
        return support - 3.0 * contradiction

    def refined(self, symmetry: Symmetry) -> Symmetry:
        """The symmetry moved to where the carried points lie on the planes of those they meet."""
        for reach in np.geomspace(4.0, 1.5, _ROUNDS) * self.tolerance:
            pairs = [self.matches(image, reach) for image in symmetry.images(self.surface)]
            if sum(len(carried) for carried, _ in pairs) < 30:
                return symmetry
            start = symmetry

            def residuals(x: np.ndarray, start: Symmetry = start, pairs: list = pairs) -> np.ndarray:
                images = _moved(start, x, self.size).images(self.surface)
                return np.concatenate(
                    [
                        ((image.points[carried] - self.surface.points[met]) * self.surface.normals[met]).sum(
                            -1
                        )
                        for image, (carried, met) in zip(images, pairs, strict=True)
                    ]
                )

            step = scipy.optimize.least_squares(
                residuals, np.zeros(4), loss="soft_l1", f_scale=0.5 * self.tolerance, max_nfev=4
            )
            symmetry = _moved(start, step.x, self.size)
        return symmetry

    def sharpness(self, symmetry: Symmetry) -> float:
        """How much worse the least bad of some small moves is."""
        shift, turn = 1.5 * self.tolerance / self.size, np.radians(5.0)
        # A plane has one shift that matters, along its normal; an axis two, across.
        moves = [
            *((shift if symmetry.kind == "axis" else 0.0, 0, 0, 0), (0, shift, 0, 0)),
            *((0, 0, turn, 0), (0, 0, 0, turn)),
        ]
        tried = [
            _moved(symmetry, sign * np.array(move), self.size)
            for move in moves
            if any(move)
            for sign in (1, -1)
        ]
        return self.worth(symmetry) - max(self.worth(other) for other in tried)


def _moved(symmetry: Symmetry, x: np.ndarray, size: float) -> Symmetry:
    """A plane shifted by x[1] along its normal, an axis by x[:2] across; turned by x[2:] radians about them."""
    first, second = _across(symmetry.direction)
    direction = symmetry.direction + x[2] * first + x[3] * second
    direction = direction / np.linalg.norm(direction)
    shift = x[1] * symmetry.direction if symmetry.kind == "plane" else x[0] * first + x[1] * second
    return Symmetry(symmetry.kind, symmetry.point + size * shift, direction)


def _across(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors at right angles to a unit direction and to each other."""
    helper = np.eye(3)[np.argmin(np.abs(direction))]
    first = np.cross(direction, helper)
    first = first / np.linalg.norm(first)
    return first, np.cross(direction, first)


def find_symmetries(
    surface: SeenSurface, is_empty: IsEmpty, config: SymmetryConfig = SymmetryConfig()
) -> list[Symmetry]:
    """The symmetries for which the evidence is strong, best first; often there are none.

    Args:
        surface: what was seen, at least a few hundred samples.
        is_empty: see `IsEmpty`.
        config: what counts as strong.
    """
    if len(surface.points) < 100:
        return []
    judge = _Judge(surface, is_empty, config)
    found: list[Symmetry] = []
    for candidates in (_plane_candidates(surface), _axis_candidates(surface)):
        ranked = sorted(candidates, key=judge.worth, reverse=True)[:_FINALISTS]
        for symmetry in sorted(map(judge.refined, ranked), key=judge.worth, reverse=True):
            if any(_alike(symmetry, other, judge.size) for other in found):
                continue
            support, contradiction, color = judge.score(symmetry)
            if (
                support >= config.least_support
                and contradiction <= config.most_contradiction
                and color <= config.most_color_error
                and judge.sharpness(symmetry) >= config.least_sharpness
            ):
                found.append(
                    Symmetry(symmetry.kind, symmetry.point, symmetry.direction, support, contradiction)
                )
    return found


def _alike(a: Symmetry, b: Symmetry, size: float) -> bool:
    return (
        a.kind == b.kind
        and abs(a.direction @ b.direction) > np.cos(np.radians(12.0))
        and abs((a.point - b.point) @ a.direction) < 0.08 * size
    )


def _plane_candidates(surface: SeenSurface) -> list[Symmetry]:
    """Planes that many pairs of samples are mirrored by, and all directions through the box's middle."""
    rng = np.random.default_rng(0)
    chosen = rng.permutation(len(surface.points))[:_VOTERS]
    p, n, c = surface.points[chosen], surface.normals[chosen], surface.colors[chosen]
    first, second = np.triu_indices(len(p), 1)
    between = p[first] - p[second]
    length = np.linalg.norm(between, axis=-1)
    size = np.ptp(p, axis=0).max()
    direction = between / np.maximum(length, 1e-9)[:, None]
    mirrored = n[first] - 2.0 * (n[first] * direction).sum(-1, keepdims=True) * direction
    good = (length > 0.15 * size) & ((mirrored * n[second]).sum(-1) > 0.94)
    # A pair whose normals are the same and at right angles to what joins them is mirrored by chance as well.
    good &= np.abs((n[first] * direction).sum(-1)) > 0.2
    good &= np.abs(c[first] - c[second]).mean(-1) < 0.15
    direction = direction[good]
    offset = (0.5 * (p[first[good]] + p[second[good]]) * direction).sum(-1)
    bins = sphere_directions(400)
    bins = bins[bins[:, 2] >= 0.0]
    cosine = direction @ bins.T
    nearest = np.abs(cosine).argmax(1)
    offset = offset * np.sign(cosine[np.arange(len(cosine)), nearest])
    step = 0.03 * size
    cells, votes = np.unique(
        np.stack([nearest, np.rint(offset / step).astype(int)], axis=-1), axis=0, return_counts=True
    )
    best = cells[np.argsort(-votes, kind="stable")[:60]]
    planes = [Symmetry("plane", step * cell * bins[which], bins[which]) for which, cell in best]
    middle = 0.5 * (surface.points.min(0) + surface.points.max(0))
    return planes + [Symmetry("plane", middle, axis) for axis in bins[::4]]


def _axis_candidates(surface: SeenSurface) -> list[Symmetry]:
    """Lines that the normals of many samples meet (Pottmann and Randrup, "Rotational and helical surfaces")."""
    rng = np.random.default_rng(0)
    size = np.ptp(surface.points, axis=0).max()
    middle = surface.points.mean(0)
    p, n = (surface.points - middle) / size, surface.normals
    moments = np.concatenate([np.cross(p, n), n], axis=-1)  # a line (l, m) meets a normal when their product is 0
    lines = []
    for _ in range(60):
        chosen = rng.choice(len(p), 40, replace=False)
        _, _, rows = np.linalg.svd(moments[chosen])
        lines.append(rows[-1])
    result = []
    for line in lines:
        direction, moment = line[:3], line[3:]
        length = np.linalg.norm(direction)
        if length < 1e-3:
            continue
        direction, moment = direction / length, moment / length
        point = middle + size * np.cross(direction, moment)
        result.append(Symmetry("axis", point, direction))
    return result


def completed(
    surface: SeenSurface, symmetries: Iterable[Symmetry], is_empty: IsEmpty, gap: float
) -> SeenSurface:
    """The seen surface with what its symmetries add where nothing was seen.

    Symmetries are applied one after the other, so that two mirror planes fill all four quarters. A carried
    point is added when it is further than `gap` metres from all that is there, and not in empty space.
    """
    whole = surface
    for symmetry in symmetries:
        for image in symmetry.images(whole):
            distance, _ = scipy.spatial.cKDTree(whole.points).query(image.points)
            new = distance > gap
            new[new] &= ~is_empty(image.points[new])
            whole = SeenSurface(
                np.concatenate([whole.points, image.points[new]]),
                np.concatenate([whole.normals, image.normals[new]]),
                np.concatenate([whole.colors, image.colors[new]]),
            )
    return whole

"""The search for an object's symmetries: candidates that samples vote for, refined and judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.optimize

from bigs.fused.shape import SymmetryJudge
from bigs.geometry.coverage import sphere_directions
from bigs.geometry.symmetry import TURNS, EmptySpace, SeenSurface, Symmetry, across, completed

# Number of candidates that are refined, of those that are polished at a time, and of samples that vote.
_FINALISTS = 14
_POLISHED = 4
_VOTERS = 400
# Of the many turns about an axis every eighth sample will do.
_EVERY = 8
# Cosine of 35 degrees.
_LEAST_COSINE = 0.82
# A plane's place is searched this many tolerances to either side.
_REACH = 8
# Angles between mirror planes, degrees: smaller ones make a body that is nearly one of revolution.
_BETWEEN_PLANES = np.array([45.0, 60.0, 90.0])
# How far angles found are off, degrees.
_SLACK = 5.0
# Directions across a known plane in which others are looked for.
_DIRECTIONS = 24
# Most symmetries that are searched: three planes fill every octant.
_MOST = 3


@dataclass(frozen=True)
class SymmetryConfig:
    """When a symmetry counts as found. Lengths are shares of the object's longest side."""

    # A carried point meets seen surface if it is this near, with a normal within 35 degrees.
    tolerance: float = 0.02
    # Smallest share of the carried points that must meet seen surface (support).
    least_support: float = 0.12
    # Smallest share of support in support and contradiction together, for the first symmetry and for those
    # after it: what the first has completed supports a wrong one as well as a right one.
    least_share: float = 0.85
    least_share_later: float = 0.96
    # Largest share of contradiction, absolute and relative to the support: where much was seen, wrong poses
    # and masks contradict everywhere a little.
    most_contradiction: float = 0.06
    contradiction_per_support: float = 0.13
    # Smallest share that must fall where nobody looked: otherwise the symmetry adds nothing.
    least_new: float = 0.05
    # Colours that meet must differ by less than this share of random pairs' difference.
    most_color_error: float = 0.85
    # Colours need not agree where shape alone says enough: support, and its share, of at least this much.
    plain_support: float = 0.4
    plain_share: float = 0.95
    # Loss, in support less three times the contradictions, that a shift by 1.5 tolerances or a turn by 5
    # degrees must cause.
    least_sharpness: float = 0.015


def find_symmetries(
    surface: SeenSurface,
    is_empty: EmptySpace,
    config: SymmetryConfig = SymmetryConfig(),
    earlier: Sequence[Symmetry] = (),
) -> list[Symmetry]:
    """The symmetries with strong evidence, in the order in which they were found; often none.

    After each one the search begins anew on the surface that it completes: what was seen of one side of a box
    says nothing about its back, what two sides say together does.

    Args:
        surface: what was seen, at least a few hundred samples.
        is_empty: where nothing is.
        config: what counts as strong.
        earlier: symmetries with strong evidence on a surface much like this one. If it is still strong for
            one of them nearby, no other of its kind is looked for: that takes seconds.
    """
    found: list[Symmetry] = []
    while len(found) < _MOST and len(surface.points) >= 100:
        judge = _Judge(surface, is_empty, config)
        # An axis completes more than any plane, and only a body of revolution passes as one.
        axes, planes = ([s for s in earlier if s.kind == kind] for kind in ("axis", "plane"))
        best = None if found else judge.strongest(axes, found) or judge.best(_axis_candidates(surface), found)
        best = best or judge.strongest(planes, found)
        best = best or judge.best(_plane_candidates(surface) + judge.planes_across(found), found)
        if best is None:
            break
        found.append(best)
        surface = completed(surface, [best], is_empty, judge.tolerance)
    return found


class _Agreement(NamedTuple):
    """What speaks for a symmetry and against it."""

    support: float  # share of what is carried
    contradiction: float  # likewise
    color: float  # the colours' error relative to chance


class _Judge:
    """Scores symmetries against what was seen."""

    def __init__(self, surface: SeenSurface, is_empty: EmptySpace, config: SymmetryConfig) -> None:
        self.config = config
        self.size = float(np.ptp(surface.points, axis=0).max())
        self.tolerance = config.tolerance * self.size
        self.points = surface.points
        middle = np.median(surface.colors, axis=0)
        # Difference of two random colours of the surface; never so small that noise decides.
        self.chance = max(1.4 * float(np.abs(surface.colors - middle).mean()), 0.02)
        self.compiled = SymmetryJudge(
            surface,
            is_empty.values,
            is_empty.origin,
            is_empty.spacing,
            self.tolerance,
            _LEAST_COSINE,
            TURNS,
            _EVERY,
        )

    def agreement(self, symmetries: Sequence[Symmetry]) -> list[_Agreement]:
        """What speaks for each symmetry and against it."""
        found = self.compiled.agreement(
            [symmetry.kind == "axis" for symmetry in symmetries], _rows(symmetries)
        )
        return [
            _Agreement(support, contradiction, error / self.chance if support > 0.0 else np.inf)
            for support, contradiction, error in found.tolist()
        ]

    def worths(self, symmetries: Sequence[Symmetry]) -> list[float]:
        return [found.support - 3.0 * found.contradiction for found in self.agreement(symmetries)]

    def ranked(self, symmetries: Sequence[Symmetry]) -> list[Symmetry]:
        """The same, best first."""
        order = np.argsort(-np.array(self.worths(symmetries)), kind="stable")
        return [symmetries[index] for index in order]

    def planes_across(self, known: Sequence[Symmetry]) -> list[Symmetry]:
        """Planes at right angles to those known: two mirror planes at any other angle are rare."""
        middle = _middle(self.points)
        found: list[Symmetry] = []
        for plane in known:
            if plane.kind == "plane":
                first, second = across(plane.direction)
                for angle in np.arange(_DIRECTIONS) * (np.pi / _DIRECTIONS):
                    normal = np.cos(angle) * first + np.sin(angle) * second
                    found.append(Symmetry("plane", middle, normal))
        return self._placed(found)

    def best(self, candidates: list[Symmetry], known: list[Symmetry]) -> Symmetry | None:
        """The refined candidate that agrees best; None if that is not enough."""
        finalists = self._distinct(self.ranked(candidates), known)[:_FINALISTS]
        refined = self._distinct(self.ranked(self._placed(self._refined(finalists))), known)
        for first in range(0, len(refined), _POLISHED):
            found = self.strongest(refined[first : first + _POLISHED], known)
            if found is not None:
                return found
        return None

    def strongest(self, near: Sequence[Symmetry], known: list[Symmetry]) -> Symmetry | None:
        """The one that agrees best of symmetries `near` the right place, moved there; None if not enough."""
        polished = [self._polished(symmetry) for symmetry in self._distinct(near, known)]
        for symmetry in self.ranked(polished):
            (found,) = self.agreement([symmetry])
            if self._is_strong(symmetry, found, known):
                return replace(symmetry, support=found.support, contradiction=found.contradiction)
        return None

    def _distinct(self, symmetries: Sequence[Symmetry], known: Sequence[Symmetry]) -> list[Symmetry]:
        """Those that are neither known nor like one before them."""
        kept: list[Symmetry] = []
        for symmetry in symmetries:
            if not any(_alike(symmetry, other, self.size) for other in (*known, *kept)):
                kept.append(symmetry)
        return kept

    def _is_strong(self, symmetry: Symmetry, found: _Agreement, known: Sequence[Symmetry]) -> bool:
        """Whether the evidence is enough for a symmetry that is not known yet."""
        config = self.config
        support, contradiction = found.support, found.contradiction
        judged = support + contradiction
        # Print need not continue from one side to the other: where the shape says enough, it may differ.
        plain = support >= max(config.plain_support, config.plain_share * judged)
        return (
            not any(_alike(symmetry, other, self.size) for other in known)
            and all(_compatible(symmetry, other) for other in known)
            and judged <= 1.0 - config.least_new
            and support >= config.least_support
            and support >= judged * (config.least_share_later if known else config.least_share)
            and contradiction <= max(config.most_contradiction, config.contradiction_per_support * support)
            and (plain or found.color <= config.most_color_error)
            and self._sharpness(symmetry) >= config.least_sharpness
            and all(self._makes_others(symmetry, other) for other in known)
        )

    def _makes_others(self, a: Symmetry, b: Symmetry) -> bool:
        """Whether what two mirror planes make of each other are planes of the same object.

        Symmetries of a body form a group. Two planes at the right angle in the wrong place do not.
        """
        if "axis" in (a.kind, b.kind):
            return True
        # Errors of both planes add up.
        least = 1.0 - 2.0 * (1.0 - self.config.least_share_later)
        return all(
            found.support >= least * (found.support + found.contradiction)
            for found in self.agreement([a.mirrored(b), b.mirrored(a)])
        )

    def _refined(self, symmetries: Sequence[Symmetry]) -> list[Symmetry]:
        """The symmetries moved to where the carried points lie on the planes of those they meet.

        One stays where that is no gain: on a flat side most points lie on the planes of others anyhow.
        """
        axes = [symmetry.kind == "axis" for symmetry in symmetries]
        rows = self.compiled.refined(axes, _rows(symmetries), self.size)
        moved = [Symmetry(old.kind, row[:3], row[3:]) for old, row in zip(symmetries, rows, strict=True)]
        better = np.array(self.worths(moved)) > self.worths(symmetries)
        return [new if gain else old for old, new, gain in zip(symmetries, moved, better, strict=True)]

    def _placed(self, symmetries: Sequence[Symmetry]) -> list[Symmetry]:
        """Of planes parallel to each the one that agrees best; axes as they are.

        A flat side says nothing of where the plane that halves it lies, its ends do, and far from the right
        place nothing leads there.
        """
        places = self.config.tolerance * np.arange(-_REACH, _REACH + 1)
        moves = [np.array([0.0, place, 0.0, 0.0]) for place in places]
        return [
            self.ranked([symmetry.moved(move, self.size) for move in moves])[0]
            if symmetry.kind == "plane"
            else symmetry
            for symmetry in symmetries
        ]

    def _polished(self, symmetry: Symmetry) -> Symmetry:
        """The symmetry moved a little to where it agrees best."""
        simplex = np.vstack([np.zeros(4), np.diag([0.02, 0.02, 0.06, 0.06])])
        found = scipy.optimize.minimize(
            lambda x: -self.worths([symmetry.moved(x, self.size)])[0],
            np.zeros(4),
            method="Nelder-Mead",
            options={"maxfev": 60, "initial_simplex": simplex},
        )
        return symmetry.moved(found.x, self.size)

    def _sharpness(self, symmetry: Symmetry) -> float:
        """The smallest loss that any of some small moves causes."""
        shift, turn = 1.5 * self.config.tolerance, np.radians(5.0)
        moves = [(0.0, shift, 0.0, 0.0), (0.0, 0.0, turn, 0.0), (0.0, 0.0, 0.0, turn)]
        if symmetry.kind == "axis":
            moves.append((shift, 0.0, 0.0, 0.0))
        tried = [symmetry.moved(sign * np.array(move), self.size) for move in moves for sign in (1.0, -1.0)]
        own, *others = self.worths([symmetry, *tried])
        return own - max(others)


def _rows(symmetries: Sequence[Symmetry]) -> np.ndarray:
    """Points and directions [M, 6]."""
    return np.array([[*symmetry.point, *symmetry.direction] for symmetry in symmetries]).reshape(-1, 6)


def _alike(a: Symmetry, b: Symmetry, size: float) -> bool:
    return (
        a.kind == b.kind
        and abs(a.direction @ b.direction) > np.cos(np.radians(12.0))
        and abs((a.point - b.point) @ a.direction) < 0.08 * size
    )


def _compatible(a: Symmetry, b: Symmetry) -> bool:
    """Whether one object may have both.

    Two mirror planes make a rotation by twice the angle between them, which a whole number of times must be
    a full turn. An axis is taken as it comes.
    """
    if "axis" in (a.kind, b.kind):
        return True
    angle = np.degrees(np.arccos(min(abs(float(a.direction @ b.direction)), 1.0)))
    return bool(np.abs(angle - _BETWEEN_PLANES).min() < _SLACK)


def _middle(points: np.ndarray) -> np.ndarray:
    """The middle [3] of the box around points [N, 3]."""
    return 0.5 * (points.min(0) + points.max(0))


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
    # A pair with equal normals, orthogonal to the line between them, is mirrored by chance as well.
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
    middle = _middle(surface.points)
    return planes + [Symmetry("plane", middle, axis) for axis in bins[::4]]


def _axis_candidates(surface: SeenSurface) -> list[Symmetry]:
    """Lines that the normals of many samples meet.

    The normals of a surface of revolution meet its axis: Pottmann and Randrup, "Rotational and helical
    surface approximation for reverse engineering" (1998).
    """
    rng = np.random.default_rng(0)
    size = np.ptp(surface.points, axis=0).max()
    middle = surface.points.mean(0)
    points = (surface.points - middle) / size
    # A line (direction, moment) meets a normal where their product is zero.
    moments = np.concatenate([np.cross(points, surface.normals), surface.normals], axis=-1)
    result = []
    for _ in range(40):
        chosen = rng.choice(len(moments), 40, replace=False)
        direction, moment = np.linalg.svd(moments[chosen])[2][-1].reshape(2, 3)
        length = np.linalg.norm(direction)
        if length > 1e-3:
            foot = np.cross(direction, moment) / length**2
            result.append(Symmetry("axis", middle + size * foot, direction / length))
    return result

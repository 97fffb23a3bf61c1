"""Completion of the object's unseen surface by symmetry, where the evidence is strong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.spatial

from bigs.geometry.coverage import times_empty
from bigs.geometry.support import seen_samples
from bigs.geometry.symmetry import EmptySpace, SeenSurface, Symmetry, completed
from bigs.geometry.symmetry_search import find_symmetries
from bigs.train.plan.start_config import CompletionConfig, InitialConfig
from bigs.train.start.initial import ObjectStart
from bigs.train.start.visual_hull import ClosedSurface, ObjectHull


@dataclass(frozen=True)
class Completion:
    """The object's completed surface."""

    surface: ClosedSurface
    seen: float  # share of the surface that the clip shows
    symmetries: list[Symmetry]
    points: np.ndarray  # [M, 3] the added points, metres
    colors: np.ndarray  # [M, 3]
    why_not: str = ""  # why nothing was added

    def __str__(self) -> str:
        if not self.symmetries:
            return self.why_not
        kinds = [symmetry.kind for symmetry in self.symmetries]
        names = {"plane": "mirror plane", "axis": "axis of revolution"}
        found = ", ".join(
            f"{kinds.count(kind)} {name}{'s' if kinds.count(kind) > 1 else ''}"
            for kind, name in names.items()
            if kind in kinds
        )
        return f"{found} found, {len(self.points)} points added where nothing was seen"


# The hull, which three frames agree on, gets this share of that tolerance.
_OUTSIDE = 0.67


def complete(
    hull: ObjectHull,
    start: ObjectStart,
    initial: InitialConfig,
    config: CompletionConfig,
    earlier: Sequence[Symmetry] = (),
) -> Completion:
    """The object's surface; where it was never seen, by its symmetries if it has any.

    The search is a matter of seconds.

    Args:
        hull, start, initial, config: see those classes.
        earlier: symmetries for which the evidence was strong before; they are tried first, and count if
            the evidence is not strong for any now.
    """
    plain = hull.closed(initial, hull.points, hull.normals)
    points, normals, seen = seen_samples(
        hull.views, *plain.mesh(), initial.seen_frames, initial.seen_tolerance
    )
    nothing = Completion(plain, float(seen.mean()), [], np.empty((0, 3)), np.empty((0, 3)))
    if nothing.seen >= config.enough:
        return replace(nothing, why_not=f"{nothing.seen:.0%} of the object's surface was seen")
    tree = scipy.spatial.cKDTree(start.points)
    distance, nearest = tree.query(points)
    measured = seen & (distance < config.measured)
    colors = np.full((len(start.points), 3), 0.5) if start.colors is None else start.colors
    surface = SeenSurface(points[measured], normals[measured], colors[nearest[measured]])
    is_empty = _empty_space(hull, surface, initial)
    symmetries = find_symmetries(surface, is_empty, config.symmetry, earlier) or list(earlier)
    if not symmetries:
        return replace(nothing, why_not="no strong evidence for any")
    known = SeenSurface(hull.points, hull.normals, colors[tree.query(hull.points)[1]])
    whole = completed(known, symmetries, is_empty, config.gap)
    closed = hull.closed(initial, whole.points, whole.normals, symmetries)
    added = slice(len(known.points), None)
    return Completion(closed, nothing.seen, symmetries, whole.points[added], whole.colors[added])


def _empty_space(hull: ObjectHull, surface: SeenSurface, config: InitialConfig) -> EmptySpace:
    """Where the clip shows that there is no object: outside the silhouettes, or before what was seen."""
    grid = hull.grid
    corners = grid.points()
    outside = grid.values.ravel()
    near = np.flatnonzero(outside < config.seen_tolerance)
    empty = np.ones(len(corners))
    before = times_empty(hull.views, corners[near], surface.points, config.seen_tolerance)
    empty[near] = (outside[near] > _OUTSIDE * config.seen_tolerance) | (before >= config.seen_frames)
    return EmptySpace(empty.reshape(grid.values.shape), grid.origin, grid.spacing)

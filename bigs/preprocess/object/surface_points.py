"""Points on the object where features tell nothing: plain sides, and what never shows.

A plain side's surface is where its silhouettes end. A side that a hand hides in all frames, or that is turned
away, is closed: the surface there is the points' convex hull within the silhouettes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.spatial
import trimesh

from bigs.geometry.coverage import ObjectViews, seen_in, times_seen
from bigs.geometry.surface import DistanceGrid, extract_mesh, inlier_points, neighbour_distances
from bigs.motion.points import normalisation
from bigs.preprocess.artefacts import Alignment, ObjectSfm
from bigs.preprocess.object.rough_surface import SurfaceConfig, rough_surface, sights
from bigs.types import MASK_VALUES


@dataclass(frozen=True)
class SurfacePointsConfig:
    """Lengths in metres."""

    surface: SurfaceConfig = field(
        default_factory=lambda: SurfaceConfig(resolution=72, frames=60, margin=0.006)
    )
    # A point of structure from motion further than this outside the silhouettes is an outlier.
    outside: float = 0.004
    # The surface gets points where there is none within this distance, ...
    gap: float = 0.004
    # ... spaced by this many usual distances of the others (much sparser ones would count as outliers), ...
    sparser: float = 1.2
    # ... where a silhouette passes within this distance and it shows in this many frames, or where it shows
    # in none.
    tight: float = 0.004
    least_seen: int = 2
    # Largest distance behind the nearest surface of its pixel.
    tolerance: float = 0.004


def complete_points(
    sfm: ObjectSfm,
    alignment: Alignment,
    image: Callable[[int], np.ndarray],
    masks: np.ndarray,
    K: np.ndarray,
    config: SurfacePointsConfig,
) -> ObjectSfm:
    """The object with points all around where features told nothing, and without strays outside silhouettes.

    Args:
        sfm: points and confidence.
        alignment: metric size and poses.
        image: gives the picture [H, W, 3] uint8 of a frame.
        masks: [T, H, W] labels of `bigs.types.MASK_VALUES`.
        K: [3, 3].
        config: see there.

    Returns:
        The same motion; `points`, `colors` and `norm_mat` are new. A cloud that is too small or that its
        silhouettes contradict altogether stays as it is.
    """
    points = alignment.scale * sfm.points
    poses = (alignment.object_rotations, alignment.object_transl)
    core = points[inlier_points(points)]
    seen = sights(core, *poses, sfm.confidence, masks, K, config.surface)
    hull = seen.hull
    inside = hull.distance(points) < config.outside
    core = points[inside & inlier_points(points)]
    if len(core) < _FEWEST_POINTS:
        return sfm
    surface = rough_surface(core, seen, config.surface).solid
    if not (surface.values < 0).any():
        return sfm
    usable = np.flatnonzero(sfm.confidence > 0) if (sfm.confidence > 0).any() else np.arange(len(masks))
    views = ObjectViews(masks[usable] == MASK_VALUES["object"], K, poses[0][usable], poses[1][usable])
    spacing = config.sparser * float(np.median(neighbour_distances(core)))
    samples, normals = _samples(surface, core, spacing)
    bare = np.flatnonzero(scipy.spatial.cKDTree(core).query(samples)[0] > config.gap)
    times = times_seen(views, samples[bare], normals[bare], samples, config.tolerance)
    told = (times >= config.least_seen) & (hull.distance(samples[bare]) > -config.tight)
    bare = bare[told | (times == 0)]
    chosen = bare[_spread(samples[bare], spacing)]
    shades = _seen_colors(views, (image(int(t)) for t in usable), (samples, normals), chosen, config)
    united = np.concatenate([points[inside], samples[chosen]])
    colors = np.concatenate(
        [sfm.colors[inside], _lent(samples[chosen], shades, points[inside], sfm.colors[inside])]
    )
    return replace(
        sfm,
        points=united / alignment.scale,
        colors=colors.round().astype(np.uint8),
        norm_mat=normalisation(united / alignment.scale),
    )


# Fewer points give no surface.
_FEWEST_POINTS = 30


def _seen_colors(
    views: ObjectViews,
    images: Iterable[np.ndarray],
    surface: tuple[np.ndarray, np.ndarray],
    chosen: np.ndarray,
    config: SurfacePointsConfig,
) -> np.ndarray:
    """Median colours [n, 3] of the samples `chosen` [n] of a surface where they show; NaN where they do not.

    `images` are those of the frames of `views`; `surface` is samples [N, 3] and their normals.
    """
    samples, normals = surface
    observations: list[list[np.ndarray]] = [[] for _ in chosen]
    for t, image in enumerate(images):
        shows = seen_in(views, t, samples[chosen], normals[chosen], samples, config.tolerance)
        row, column, _, _ = views.pixels(t, samples[chosen[shows]])
        for i, color in zip(np.flatnonzero(shows), image[row, column], strict=True):
            observations[i].append(color)
    unknown = np.full(3, np.nan)
    return np.array([np.median(shown, axis=0) if shown else unknown for shown in observations]).reshape(-1, 3)


def _lent(points: np.ndarray, colors: np.ndarray, others: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Colours [n, 3] of points [n, 3]; where they are NaN, the mean of the nearest points that have some.

    `others` [N, 3] are points with colours `theirs` [N, 3].
    """
    shown = np.isfinite(colors).all(1)
    known = np.concatenate([others, points[shown]]), np.concatenate([theirs, colors[shown]])
    colors = colors.copy()
    nearest = scipy.spatial.cKDTree(known[0]).query(points[~shown], k=_LENDERS)[1]
    colors[~shown] = known[1][nearest].mean(1)
    return colors


_LENDERS = 3


def _samples(surface: DistanceGrid, points: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Dense samples [N, 3] of a surface through points [M, 3], and their normals; the same in every run."""
    verts, faces = extract_mesh(surface, points)
    mesh = trimesh.Trimesh(verts, faces, process=False)
    count = max(int(_DENSITY * mesh.area / spacing**2), 1)
    samples, face = trimesh.sample.sample_surface(mesh, count, seed=0)
    return np.asarray(samples), np.asarray(mesh.face_normals[face])


# Samples of the surface per square of the spacing.
_DENSITY = 12.0


def _spread(points: np.ndarray, spacing: float) -> np.ndarray:
    """Which points [n] to keep so that no two are nearer than `spacing`; the earlier ones stay."""
    near = scipy.spatial.cKDTree(points).query_ball_point(points, spacing) if len(points) else []
    free = np.ones(len(points), dtype=bool)
    kept = []
    for i, others in enumerate(near):
        if free[i]:
            free[others] = False
            kept.append(i)
    return np.array(kept, dtype=int)

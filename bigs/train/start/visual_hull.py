"""The object's start surface: from masks and points, and closed elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.spatial
from scipy.ndimage import binary_dilation, gaussian_filter

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.geometry.coverage import ObjectViews
from bigs.geometry.normals import outward_normals
from bigs.geometry.surface import (
    DistanceGrid,
    VisualHull,
    blend_with_points,
    convex_distance,
    distance_to_planes,
    empty_grid,
    extract_mesh,
    inlier_points,
    silhouette_around_points,
)
from bigs.geometry.symmetry import SeenSurface, Symmetry
from bigs.threads import side_by_side
from bigs.train.plan.start_config import InitialConfig
from bigs.train.start.far_side import far_side_depth
from bigs.train.start.initial import ObjectStart
from bigs.train.start.protrusions import protruding
from bigs.types import MASK_VALUES

# Fewer points give no surface.
_MIN_POINTS = 30
# One stray point moves the convex hull of all: those that bound it have neighbours within this many times the
# usual distance.
_STRAY = 2.0


def usable_silhouettes(clip: Clip, start: ObjectStart) -> list[int]:
    """Frames whose silhouette may carve the object: it is visible, and its pose was measured.

    An interpolated pose carves what it should not; such frames serve only when there are hardly any others.
    """
    shown = [t for t in range(len(clip)) if clip.mask_areas["object"][t] > 0]
    trusted = [t for t in shown if start.trust[t] == 1.0]
    return trusted if len(trusted) >= min(len(shown), 5) else shown


def usable_views(clip: Clip, start: ObjectStart) -> ObjectViews | None:
    """The frames whose silhouette may carve the object; None without any."""
    usable = usable_silhouettes(clip, start)
    return _views_at(clip, start, usable)[0] if usable else None


def _views_at(clip: Clip, start: ObjectStart, frames: list[int]) -> tuple[ObjectViews, np.ndarray]:
    """Some of the clip's frames, and their labels [F, H, W]."""
    labels = np.stack(side_by_side(clip.mask, frames))
    rotations, centers = start.rotations[frames].numpy(), start.centers[frames].numpy()
    return ObjectViews(labels == MASK_VALUES["object"], clip.K, rotations, centers), labels


def convex_surface(start: ObjectStart, config: InitialConfig) -> DistanceGrid:
    """The fallback: the convex hull of the points.

    Raises:
        InputError: the points span no volume.
    """
    size = (start.points.max(0) - start.points.min(0)).max()
    grid = empty_grid(
        start.points.min(0) - 0.1 * size, start.points.max(0) + 0.1 * size, config.surface_resolution
    )
    try:
        distance = convex_distance(grid.points(), start.points)
    except scipy.spatial.QhullError:
        raise InputError(
            "entities.object: pts.cano: expected points that span a volume, "
            f"found {len(start.points)} in a plane or fewer than four"
        ) from None
    return DistanceGrid(distance.reshape(grid.values.shape), grid.origin, grid.spacing)


@dataclass(frozen=True)
class ClosedSurface:
    """A surface without gaps, and what holds its pieces."""

    grid: DistanceGrid
    held_at: np.ndarray  # [N, 3] metres: the points that it goes through, and places that masks show

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Its vertices [V, 3] and faces [F, 3]; see `extract_mesh`."""
        return extract_mesh(self.grid, self.held_at)


@dataclass(frozen=True)
class ObjectHull:
    """The visual hull from the clip's frames, and the object's points in it."""

    grid: DistanceGrid  # distance to the visual hull; exact up to `InitialConfig.surface_reach`
    points: np.ndarray  # [N, 3] metres, inside the silhouettes
    normals: np.ndarray  # [N, 3] unit, outward
    views: ObjectViews  # of the frames that count

    def closed(
        self,
        config: InitialConfig,
        points: np.ndarray,
        normals: np.ndarray,
        symmetries: Sequence[Symmetry] = (),
    ) -> ClosedSurface:
        """The surface through points [N, 3] with normals, within their convex hull or little more.

        Beyond faces of that hull that no camera looked at, the object reaches as far as silhouettes ask for.
        Beyond the others it would have hidden the points, but for parts that show beside them (see
        `protrusions`). With `symmetries`, which have added their points, cameras also looked at what these
        make of it.
        """
        distance = self.grid.values.ravel().copy()
        doubtful = np.flatnonzero(distance < config.surface_reach)
        bounding = points[inlier_points(points, factor=_STRAY)]
        faces = scipy.spatial.ConvexHull(bounding)
        planes = faces.equations
        least = min(config.seen_frames, len(self.views.shown))
        turned = np.ones(len(planes), dtype=bool)
        for places, facing in _carried(bounding[faces.simplices].mean(1), planes[:, :3], symmetries):
            turned &= self._frames_facing(places, facing) < least
        corners = self.grid.points()[doubtful]
        if turned.any() and not turned.all():
            beyond = distance_to_planes(corners, planes[~turned]) - config.surface_margin
            behind = distance_to_planes(corners, planes[turned]) - config.surface_margin
            possible = (distance[doubtful] < 0.0) & (beyond <= 0.0)
            behind -= far_side_depth(
                self.views, corners[possible], behind[possible], self.grid.spacing, config.surface_price
            )
            beyond = np.maximum(beyond, behind)
        else:
            beyond = distance_to_planes(corners, planes) - config.surface_margin
        distance[doubtful] = np.maximum(distance[doubtful], beyond)
        carved, parts = self._with_protrusions(distance.reshape(self.grid.values.shape))
        blended = blend_with_points(replace(self.grid, values=carved), points, normals, config.surface_reach)
        smooth = replace(blended, values=gaussian_filter(blended.values, config.surface_smoothing))
        return ClosedSurface(smooth, np.concatenate([points, parts]))

    def _with_protrusions(self, carved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A carved grid [X, Y, Z] with the parts of the hull that masks show beside it.

        Returns:
            The grid, and the corners [M, 3] that came back.
        """
        corners = self.grid.points()
        # What lies deep inside shows no more than what lies around it.
        shell = (carved < 0.0) & (carved > -2.0 * self.grid.spacing)
        beside = np.flatnonzero((self.grid.values < 0.0) & (carved >= 0.0))
        beside = beside[protruding(self.views, corners[beside], corners[shell.ravel()], self.grid.spacing)]
        parts = np.zeros(carved.shape, dtype=bool)
        parts.ravel()[beside] = True
        # Their neighbours outside the hull, too, or they would end half a cell early.
        back = parts | (binary_dilation(parts) & (self.grid.values >= 0.0))
        return np.where(back, self.grid.values, carved), corners[beside]

    def _frames_facing(self, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """In how many frames [N] planes at places [N, 3] face the camera, whatever hides them."""
        facing = [
            (self.views.directions(t, places) * normals).sum(-1) > 0.0 for t in range(len(self.views.shown))
        ]
        return np.sum(facing, axis=0)


def _carried(
    points: np.ndarray, normals: np.ndarray, symmetries: Sequence[Symmetry]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points and normals [N, 3], and what symmetries one after the other carried there."""
    found = [(points, normals)]
    for symmetry in reversed(symmetries):
        found += [
            (image.points, image.normals)
            for place in found
            for image in symmetry.images(SeenSurface(*place, np.zeros_like(points)))
        ]
    return found


def find_object_hull(
    clip: Clip, unknown: np.ndarray, start: ObjectStart, config: InitialConfig
) -> ObjectHull:
    """The visual hull of the masks, and the points inside it.

    `unknown` [T, H, W] (bool) marks unlabelled occluders.

    Raises:
        ValueError: masks and poses leave nothing of the object, or too few points to tell.
    """
    usable = usable_silhouettes(clip, start)
    if not usable:
        raise ValueError("no frame shows the object")
    views, labels = _views_at(clip, start, usable)
    size = (start.points.max(0) - start.points.min(0)).max()
    lower, upper = start.points.min(0) - 0.25 * size, start.points.max(0) + 0.25 * size
    grid = empty_grid(lower, upper, config.surface_resolution)
    rotations, centers = views.rotations, views.centers
    # Anything but background may hide the object, so the object may be there.
    allowed = (labels != 0) | unknown[usable]

    def silhouette(index: int) -> np.ndarray:
        points_cam = start.points @ rotations[index].T + centers[index]
        return silhouette_around_points(allowed[index], points_cam, clip.K)

    silhouettes = side_by_side(silhouette, range(len(usable)))
    agreeing = min(config.surface_agreeing, len(usable))
    hull = VisualHull(np.stack(silhouettes), clip.K, rotations, centers, agreeing)
    corners = grid.points()
    distance = hull.distance(corners, stop=config.surface_reach)
    points = start.points[hull.distance(start.points) < 0.25 * config.surface_reach]
    if len(points) < _MIN_POINTS:
        raise ValueError(f"only {len(points)} of {len(start.points)} points lie inside the silhouettes")
    return ObjectHull(
        DistanceGrid(distance.reshape(grid.values.shape), grid.origin, grid.spacing),
        points,
        outward_normals(points, hull, views, grid.spacing, config.seen_tolerance),
        views,
    )

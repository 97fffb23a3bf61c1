"""Points of the map measured again by patches, in every frame that could show them.

A feature is found again over some thirty degrees of turn, so that a map of features is a chain of short
links and drifts. Once a map is there, it tells how the surface about a point looks from anywhere: the patch
about its most frontal observation, warped as its plane turns, is laid on every other frame and moved to where
it fits best. So a point is seen for as long as its side shows, before and after a hand hid it, and always by
the same patch, which does not drift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from PIL import Image

from bigs import _raster
from bigs.geometry.normals import point_normals
from bigs.motion.features import crop_box
from bigs.motion.object_map import ObjectMap


@dataclass(frozen=True)
class PatchConfig:
    """How patches are laid on frames; lengths in pixels of the clip's images, shrunk where they are."""

    # Crops of the object with a longer side than this are shrunk by a whole factor.
    max_side: int = 1200
    # Pixels of a patch on each side of its middle, in pictures blurred by `blur`.
    half: int = 4
    blur: float = 0.5
    # Number of neighbours of a point that determine its plane.
    neighbours: int = 14
    # Smallest cosine between the plane's normal and the view.
    least_cosine: float = 0.2
    # Share of a patch that must lie on the object, ...
    least_shown: float = 0.7
    # ... smallest correlation, and largest distance from where the map expects it.
    likeness: float = 0.8
    most_moved: float = 4.0
    # Standard deviation of its position along the direction in which it says least.
    most_unsure: float = 0.5
    # Its errors are this many times what unlikeness lets expect, and never less than `least_error`.
    optimism: float = 2.0
    least_error: float = 0.02
    # A frame with fewer recognised patches than this goes by its matches, too. ...
    enough: int = 30
    # ... In others a match whose patch was not recognised is off by so much.
    unrecognised_error: float = 0.7
    iterations: int = 10
    # Rounds of measuring and adjusting.
    passes: int = 3


class Observations(NamedTuple):
    """Which point was seen where, and how surely."""

    frame: np.ndarray  # [M]
    track: np.ndarray  # [M]
    pixels: np.ndarray  # [M, 2]
    covariances: np.ndarray  # [M, 2, 2] of these


def sharpen(map_: ObjectMap, pictures: Pictures, config: PatchConfig) -> None:
    """Measure all points by their patches and adjust everything, in place, a few times.

    Args:
        map_: with a pose in every frame.
        pictures: of the same frames.
        config: see there.
    """
    use = map_.use()
    usual = np.tile(map_.config.bundle.pixel_sigma**2 * np.eye(2), (int(use.sum()), 1, 1))
    found = matched = Observations(map_.frame[use], map_.track[use], map_.pixels[use], usual)
    frames = np.arange(len(map_.posed))
    everything = np.ones(len(frames), dtype=bool)
    for _ in range(config.passes):
        measured = _measured(map_, matched, pictures, config)
        if measured is None:
            return
        found = measured
        # Most matches whose patch was not recognised are wrong, but a frame may have nothing else.
        poor = np.bincount(found.frame, minlength=len(frames)) < config.enough
        map_.replace_observations(*_united(found, matched, poor))
        map_.judge()
        map_.adjust(frames, everything, map_.config.bundle)
        map_.judge()
    # Where they agree with these poses they are kept, since they connect frames.
    vague = np.where(poor[matched.frame, None, None], usual, config.unrecognised_error**2 * np.eye(2))
    map_.replace_observations(*_united(found, matched._replace(covariances=vague), everything))
    map_.judge()
    map_.triangulate()


def _united(found: Observations, matched: Observations, frames: np.ndarray) -> Observations:
    """The observations `found`, and those of `matched` in `frames` [T] (bool) whose patches were not."""
    total = 1 + max(observations.track.max(initial=0) for observations in (found, matched))
    missed = ~np.isin(matched.frame * total + matched.track, found.frame * total + found.track)
    missed &= frames[matched.frame]
    return Observations(
        *(np.concatenate([new, old[missed]]) for new, old in zip(found, matched, strict=True))
    )


class Pictures:
    """The object's crop of every frame in grey, and where in it the object is."""

    def __init__(
        self, images: Sequence[np.ndarray], masks: np.ndarray, config: PatchConfig, coarser: int = 1
    ) -> None:
        """T arrays [H, W, 3] uint8, and the object's pixels in them [T, H, W] (bool), shrunk by `coarser`."""
        boxes = [crop_box(mask) or (0, 1, 0, 1) for mask in masks]
        longest = max(max(box[1] - box[0], box[3] - box[2]) for box in boxes)
        self.shrunk = coarser * -(-longest // config.max_side)
        self.corners = np.array([(left, top) for top, _, left, _ in boxes], dtype=np.float64)
        self._crops = []
        for image, mask, (top, bottom, left, right) in zip(images, masks, boxes, strict=True):
            grey = Image.fromarray(image[top:bottom, left:right]).convert("L").reduce(self.shrunk)
            on = Image.fromarray(mask[top:bottom, left:right].astype(np.uint8) * 255).reduce(self.shrunk)
            smooth = scipy.ndimage.gaussian_filter(np.asarray(grey, dtype=np.float32), config.blur)
            self._crops.append(np.stack([smooth, np.asarray(on, dtype=np.float32) / np.float32(255.0)]))

    def __getitem__(self, t: int) -> np.ndarray:
        """Grey values and shares of object [2, h, w] of frame `t`."""
        return self._crops[t]

    def places(self, frames: np.ndarray | int, pixels: np.ndarray) -> np.ndarray:
        """Pixels [N, 2] of the clip's images as places in the frames' crops."""
        return ((pixels - self.corners[frames]) / self.shrunk).astype(np.float32)

    def pixels(self, t: int, places: np.ndarray) -> np.ndarray:
        """The inverse of `places`."""
        return self.shrunk * places.astype(np.float64) + self.corners[t]


class Templates(NamedTuple):
    """Patches as their own frames show them."""

    grey: np.ndarray  # [N, S]
    slope: np.ndarray  # [N, S, 2] by column and row
    weight: np.ndarray  # [N, S], 0 off the object


def _measured(
    map_: ObjectMap, matched: Observations, pictures: Pictures, config: PatchConfig
) -> Observations | None:
    """Where the known points of `matched` are seen, by their patches; None if there are too few points."""
    known = map_.known[matched.track]
    tracks, point = np.unique(matched.track[known], return_inverse=True)
    if len(tracks) < config.neighbours:
        return None
    points = map_.points[tracks]
    frame, pixels = matched.frame[known], matched.pixels[known]
    eyes = -np.einsum("tji,tj->ti", map_.rotations, map_.transl)
    views = eyes[frame] - points[point]
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    mean_view = np.zeros_like(points)
    np.add.at(mean_view, point, views)
    normals = point_normals(points, mean_view, config.neighbours)
    # The most frontal observation of each point provides its patch.
    facing = (views * normals[point]).sum(1)
    order = np.lexsort((facing, point))
    frontal = order[np.append(np.flatnonzero(np.diff(point[order])), len(order) - 1)]
    own, middle = frame[frontal], pixels[frontal]
    templates = cut_templates(pictures, own, middle, config)
    whole = (templates.weight > 0).mean(1) > config.least_shown
    whole &= facing[frontal] > config.least_cosine

    exact = config.least_error**2 * np.eye(2)
    found = []
    for t in range(len(eyes)):
        view = eyes[t] - points
        cosine = (view * normals).sum(1) / np.linalg.norm(view, axis=1)
        rows = np.flatnonzero(whole & (cosine > config.least_cosine) & (own != t))
        start, warp = _warps(map_, t, own[rows], points[rows], normals[rows])
        laid = lay(pictures, t, start, warp, Templates(*(part[rows] for part in templates)), config)
        rows = rows[laid.fits]
        covariances = config.optimism**2 * laid.covariances[laid.fits] + exact
        found.append(Observations(np.full(len(rows), t), tracks[rows], laid.pixels[laid.fits], covariances))
    # A patch's own observation counts as recognised if it was recognised elsewhere.
    again = np.isin(tracks, np.concatenate([observations.track for observations in found]))
    exactly = np.tile(exact, (int(again.sum()), 1, 1))
    found.append(Observations(own[again], tracks[again], middle[again], exactly))
    return Observations(*(np.concatenate(part) for part in zip(*found, strict=True)))


def cut_templates(pictures: Pictures, own: np.ndarray, middle: np.ndarray, config: PatchConfig) -> Templates:
    """The patches of points at pixels `middle` [N, 2] of their frames `own` [N]."""
    shape = (len(own), (2 * config.half + 1) ** 2)
    found = Templates(*(np.empty((*shape, *last), dtype=np.float32) for last in ((), (2,), ())))
    for t in np.unique(own):
        rows = np.flatnonzero(own == t)
        cut = _raster.cut_patches(pictures[t], pictures.places(t, middle[rows]), config.half)
        for whole, part in zip(found, cut, strict=True):
            whole[rows] = part.reshape(len(rows), *whole.shape[1:])
    return found


def _warps(
    map_: ObjectMap, t: int, own: np.ndarray, points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where points on planes show in frame `t` [N, 2], and how pixels of their own frames turn [N, 2, 2]."""
    K, rotation, transl = map_.K, map_.rotations[own], map_.transl[own]
    focal, centre = K[[0, 1], [0, 1]], K[:2, 2]

    def project(places: np.ndarray) -> np.ndarray:
        cam = places @ map_.rotations[t].T + map_.transl[t]
        return cam[:, :2] / cam[:, 2:] * focal + centre

    cam = np.einsum("nij,nj->ni", rotation, points) + transl
    normal = np.einsum("nij,nj->ni", rotation, normals)
    height = (normal * cam).sum(1)
    start, middle = project(points), cam[:, :2] / cam[:, 2:]
    warp = np.empty((len(own), 2, 2))
    for axis, step in enumerate(np.eye(2)):
        ray = np.concatenate([middle + step / focal, np.ones((len(own), 1))], axis=1)
        on_plane = ray * (height / (normal * ray).sum(1))[:, None]
        warp[:, :, axis] = project(np.einsum("nji,nj->ni", rotation, on_plane - transl)) - start
    return start, warp


class Laid(NamedTuple):
    """Patches as another frame shows them."""

    pixels: np.ndarray  # [N, 2]
    covariances: np.ndarray  # [N, 2, 2] of these, where what is unlike is taken for noise
    fits: np.ndarray  # [N] (bool) which were recognised and located


def lay(
    pictures: Pictures,
    t: int,
    start: np.ndarray,
    warp: np.ndarray,
    templates: Templates,
    config: PatchConfig,
) -> Laid:
    """Lay patches on frame `t`, from pixels `start` [N, 2] on, each turned by its `warp` [N, 2, 2].

    The engine moves each to where it fits best, and says whether it was recognised there.
    """
    places, covariances, fits = _raster.lay_patches(
        pictures[t],
        templates,
        pictures.places(t, start),
        warp.astype(np.float32),
        config.half,
        config.iterations,
        (config.least_shown, config.likeness, config.most_moved, config.most_unsure / pictures.shrunk),
    )
    covariances = pictures.shrunk**2 * covariances.reshape(-1, 3)[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    return Laid(pictures.pixels(t, places.reshape(-1, 2)), covariances, fits)

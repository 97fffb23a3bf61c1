"""Points of the map measured again by patches, in every frame that could show them.

A feature is found again over some thirty degrees of turn, so that a map of features is a chain of short
links and drifts. Once a map is there, it tells how the surface about a point looks from anywhere: the patch
about its most frontal sighting, warped as its plane turns, is laid on every other frame and moved to where
it fits best. So a point is seen for as long as its side shows, before and after a hand hid it, and always by
the same patch, which does not drift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import torch
from PIL import Image

from bigs.geometry.surface import point_normals
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
    most_unsure: float = 0.2
    # Matches whose patch was not recognised count only in frames with fewer recognised ones than this.
    enough: int = 30
    iterations: int = 10
    # Rounds of measuring and adjusting.
    passes: int = 3


class Sightings(NamedTuple):
    """Which point was seen where."""

    frame: np.ndarray  # [M]
    track: np.ndarray  # [M]
    pixels: np.ndarray  # [M, 2]


def sharpen(map_: ObjectMap, pictures: Pictures, config: PatchConfig) -> None:
    """Measure all points by their patches and adjust everything, in place, a few times.

    Args:
        map_: with a pose in every frame.
        pictures: of the same frames.
        config: see there.
    """
    use = map_.use()
    found = matched = Sightings(map_.frame[use], map_.track[use], map_.pixels[use])
    frames = np.arange(len(map_.posed))
    everything = np.ones(len(frames), dtype=bool)
    for _ in range(config.passes):
        measured = _measured(map_, matched, pictures, config)
        if measured is None:
            return
        found = measured
        # Most matches whose patch was not recognised are wrong, but a frame may have nothing else.
        poor = np.bincount(found.frame, minlength=len(frames)) < config.enough
        map_.replace_sightings(*_united(found, matched, poor))
        map_.judge()
        map_.adjust(frames, everything, map_.config.bundle)
        map_.judge()
    # Where they agree with these poses they are kept, since they connect frames.
    map_.replace_sightings(*_united(found, matched, everything))
    map_.judge()
    map_.triangulate()


def _united(found: Sightings, matched: Sightings, frames: np.ndarray) -> Sightings:
    """The sightings `found`, and those of `matched` in `frames` [T] (bool) whose patches were not."""
    total = 1 + max(sightings.track.max(initial=0) for sightings in (found, matched))
    missed = ~np.isin(matched.frame * total + matched.track, found.frame * total + found.track)
    missed &= frames[matched.frame]
    return Sightings(*(np.concatenate([new, old[missed]]) for new, old in zip(found, matched, strict=True)))


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
            crop = np.stack([smooth, np.asarray(on, dtype=np.float32) / 255.0])
            self._crops.append(torch.from_numpy(crop))

    def sample(self, t: int, places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Grey values and shares of object [B, S] at places [B, S, 2] of frame `t`, see `places`."""
        crop = self._crops[t]
        size = places.new_tensor([crop.shape[2], crop.shape[1]])
        grey, on = torch.nn.functional.grid_sample(
            crop[None], (2.0 * places / size - 1.0)[None], align_corners=False, padding_mode="border"
        )[0]
        inside = ((places > 0) & (places < size)).all(-1)
        return grey, on * inside

    def places(self, frames: np.ndarray | int, pixels: np.ndarray) -> torch.Tensor:
        """Pixels [N, 2] of the clip's images as places in the frames' crops."""
        return torch.from_numpy((pixels - self.corners[frames]) / self.shrunk).float()

    def pixels(self, t: int, places: torch.Tensor) -> np.ndarray:
        """The inverse of `places`."""
        return self.shrunk * places.double().numpy() + self.corners[t]


class Templates(NamedTuple):
    """Patches as their own frames show them."""

    grey: torch.Tensor  # [N, S]
    slope: torch.Tensor  # [N, S, 2] by column and row
    weight: torch.Tensor  # [N, S], 0 off the object


def _measured(
    map_: ObjectMap, matched: Sightings, pictures: Pictures, config: PatchConfig
) -> Sightings | None:
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
    offsets = patch_offsets(config)
    templates = cut_templates(pictures, own, middle, offsets, config)
    whole = (templates.weight > 0).float().mean(1).numpy() > config.least_shown
    whole &= facing[frontal] > config.least_cosine

    found = []
    for t in range(len(eyes)):
        view = eyes[t] - points
        cosine = (view * normals).sum(1) / np.linalg.norm(view, axis=1)
        rows = np.flatnonzero(whole & (cosine > config.least_cosine) & (own != t))
        start, warp = _warps(map_, t, own[rows], points[rows], normals[rows])
        laid = lay(pictures, t, start, warp, Templates(*(part[rows] for part in templates)), config)
        rows = rows[laid.fits]
        found.append(Sightings(np.full(len(rows), t), tracks[rows], laid.pixels[laid.fits]))
    # A patch's own observation counts as recognised if it was recognised elsewhere.
    again = np.isin(tracks, np.concatenate([sightings.track for sightings in found]))
    found.append(Sightings(own[again], tracks[again], middle[again]))
    return Sightings(*(np.concatenate(part) for part in zip(*found, strict=True)))


def patch_offsets(config: PatchConfig) -> torch.Tensor:
    """Places of a patch about its middle [S, 2]."""
    line = torch.arange(-config.half, config.half + 1, dtype=torch.float32)
    row, column = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([column.ravel(), row.ravel()], dim=1)


def cut_templates(
    pictures: Pictures, own: np.ndarray, middle: np.ndarray, offsets: torch.Tensor, config: PatchConfig
) -> Templates:
    """The patches of points at pixels `middle` [N, 2] of their frames `own` [N]."""
    shape = (len(own), len(offsets))
    grey, slope, weight = torch.zeros(shape), torch.zeros(*shape, 2), torch.zeros(shape)
    bell = torch.exp(-0.5 * (offsets**2).sum(1) / (0.6 * config.half) ** 2)
    half_pixel = 0.5 * torch.eye(2)
    for t in np.unique(own):
        rows = np.flatnonzero(own == t)
        places = pictures.places(int(t), middle[rows])[:, None] + offsets
        grey[rows], on = pictures.sample(int(t), places)
        weight[rows] = bell * (on > 0.99)
        for axis, step in enumerate(half_pixel):
            ahead, behind = (
                pictures.sample(int(t), places + step)[0],
                pictures.sample(int(t), places - step)[0],
            )
            slope[rows, :, axis] = ahead - behind
    return Templates(grey, slope, weight)


def _warps(
    map_: ObjectMap, t: int, own: np.ndarray, points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, torch.Tensor]:
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
    return start, torch.from_numpy(warp).float()


class Laid(NamedTuple):
    """Patches as another frame shows them."""

    pixels: np.ndarray  # [N, 2]
    fits: np.ndarray  # [N] (bool) which were recognised and located


def lay(
    pictures: Pictures,
    t: int,
    start: np.ndarray,
    warp: torch.Tensor,
    templates: Templates,
    config: PatchConfig,
) -> Laid:
    """Lay patches on frame `t`, from pixels `start` [N, 2] on.

    Gauss-Newton on the shift alone, with the template's slopes (inverse compositional); both sides are
    brought to mean 0 and deviation 1, since light changes as the object turns.
    """
    places = began = pictures.places(t, start)
    spread = torch.einsum("nij,sj->nsi", warp, patch_offsets(config))
    on = pictures.sample(t, places[:, None] + spread)[1] > 0.5
    full = templates.weight.sum(1).clamp_min(1e-9)
    weight = templates.weight * on
    shown = weight.sum(1) / full
    weight = (weight + 1e-9) / (weight + 1e-9).sum(1, keepdim=True)
    wanted, deviation = _standardised(templates.grey, weight)
    slope = templates.slope / deviation[..., None]
    slope = slope - (weight[..., None] * slope).sum(1, keepdim=True)
    normal = torch.einsum("ns,nsi,nsj->nij", weight, slope, slope)
    # An edge or a uniform patch leaves a direction open; there the map's prediction stands.
    size = normal.diagonal(dim1=1, dim2=2).sum(1)
    inverse = torch.linalg.inv(normal + (1e-3 * size + 1e-9)[:, None, None] * torch.eye(2))
    for _ in range(config.iterations):
        seen, _ = _standardised(pictures.sample(t, places[:, None] + spread)[0], weight)
        pull = torch.einsum("ns,nsi,ns->ni", weight, slope, seen - wanted)
        step = torch.einsum("nij,nj->ni", inverse, pull).clamp(-1.5, 1.5)
        places = places - torch.einsum("nij,nj->ni", warp, step)
    seen, _ = _standardised(pictures.sample(t, places[:, None] + spread)[0], weight)
    likeness = (weight * seen * wanted).sum(1)
    fits = (
        (likeness > config.likeness)
        & ((places - began).norm(dim=1) < config.most_moved)
        & (shown > config.least_shown)
    )
    # Differences count as noise.
    noise = (2.0 * (1.0 - likeness)).clamp_min(1e-6) * (weight**2).sum(1)
    sigma = (noise / torch.linalg.eigvalsh(normal)[:, 0].clamp_min(1e-9)).sqrt()
    fits &= pictures.shrunk * sigma < config.most_unsure
    return Laid(pictures.pixels(t, places), fits.numpy())


def _standardised(grey: torch.Tensor, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Values [N, S] less their weighted mean over their deviation, and that deviation [N, 1]."""
    centred = grey - (weight * grey).sum(1, keepdim=True)
    deviation = (weight * centred**2).sum(1, keepdim=True).sqrt().clamp_min(1e-3)
    return centred / deviation, deviation

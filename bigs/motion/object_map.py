"""The object's map: poses so far, points so far, and every observation with whether it is believed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.spatial

from bigs.motion.bundle import Anchor, Bundle, BundleConfig, adjust, alike
from bigs.motion.features import FrameFeatures
from bigs.motion.tracks import Tracks


@dataclass(frozen=True)
class MapConfig:
    """What counts as an observation, and how more are found; lengths in pixels of the clip's images."""

    # An observation further than this from its point's projection is wrong.
    keep_error: float = 2.0
    # A point needs this many observations, and rays that differ by this angle, degrees.
    least_observations: int = 3
    least_angle: float = 2.0
    # Known points are searched within this distance of their projection, ...
    search_radius: float = 5.0
    # ... in views that differ by at most this angle from one that saw them, degrees, ...
    search_angle: float = 40.0
    # ... with descriptors within this angle, and within this share of the second best's.
    search_descriptor: float = 0.65
    search_ratio: float = 0.9
    bundle: BundleConfig = field(default_factory=BundleConfig)


class ObjectMap:
    """Poses and points so far, and every observation with whether it is believed."""

    def __init__(
        self, features: Sequence[FrameFeatures], tracks: Tracks, K: np.ndarray, config: MapConfig
    ) -> None:
        """A map without poses and points; `tracks` join the observations of `features`, one per frame."""
        self.features, self.K, self.config = features, K, config
        # Given poses of all frames; None if there are only pictures.
        self.anchor: Anchor | None = None
        frames = len(features)
        self.rotations = np.tile(np.eye(3), (frames, 1, 1))  # [T, 3, 3] object to camera
        self.transl = np.zeros((frames, 3))
        self.posed = np.zeros(frames, dtype=bool)
        self.frame, self.feature, self.track = tracks.frame, tracks.feature, tracks.track  # [M] each
        self.pixels = np.array(
            [features[t].pixels[i] for t, i in zip(self.frame, self.feature, strict=True)]
        ).reshape(-1, 2)
        # [M, 3] inverse covariances (xx, xy, yy), in units of 1 / bundle.pixel_sigma²
        self.precision = alike(len(self.frame))
        self.good = np.ones(len(self.frame), dtype=bool)  # [M] believed
        self.points = np.zeros((tracks.total, 3))
        self.known = np.zeros(tracks.total, dtype=bool)  # which points have been triangulated

    def restart(self, frames: np.ndarray, rotations: np.ndarray, transl: np.ndarray) -> None:
        """Forget all poses and points, believe every observation, and start from the given frames' poses."""
        self.posed[:] = False
        self.rotations[frames], self.transl[frames] = rotations, transl
        self.posed[frames] = True
        self.good[:] = True
        self.known[:] = False
        self.triangulate()

    def change_camera(self, K: np.ndarray, growth: float) -> None:
        """Take other intrinsics, with depths times `growth`, as the focal length grows."""
        self.K = K
        further = np.array([1.0, 1.0, growth])
        self.transl *= further
        if self.anchor is not None:
            self.anchor = self.anchor._replace(
                transl=further * self.anchor.transl, shift_sigma=further * self.anchor.shift_sigma
            )

    def settle(self, reaches: Sequence[float] = (3.0, 1.0)) -> None:
        """Bundle adjustment of all posed frames (which must be consecutive), from coarse to fine.

        `reaches` are factors on what the configuration says of pixels, one round each.
        """
        frames = np.flatnonzero(self.posed)
        config = self.config
        for reach in reaches:
            self.config = replace(
                config,
                keep_error=reach * config.keep_error,
                bundle=replace(config.bundle, pixel_sigma=reach * config.bundle.pixel_sigma),
            )
            self.judge()
            self.triangulate()
            self.adjust(frames, np.ones(len(frames), dtype=bool), self.config.bundle)
        self.config = config
        self.judge()
        self.triangulate()

    def misfit(self) -> float:
        """Mean over the observations in posed frames of the squared error in pixels, cut off at `keep_error`.

        Counted are the tracks that could have a point: those with `least_observations` in posed frames.
        """
        _, error = self._errors()
        return float((error**2).mean()) if len(error) else np.inf

    def losses(self) -> np.ndarray:
        """Geman-McClure losses of the same observations, summed by track [N]; 1 for one that fits nowhere."""
        track, error = self._errors()
        squared = (error / (0.25 * self.config.keep_error)) ** 2
        return np.bincount(track, squared / (1.0 + squared), minlength=len(self.points))

    def _errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Tracks and errors [M] in pixels, at most `keep_error`, of the observations that `misfit` counts."""
        rows = self.posed[self.frame]
        seen = np.bincount(self.track[rows], minlength=len(self.points))
        rows &= seen[self.track] >= self.config.least_observations
        error = np.linalg.norm(self.reproject(rows) - self.pixels[rows], axis=1)
        error[~self.known[self.track[rows]]] = np.inf
        return self.track[rows], np.minimum(error, self.config.keep_error)

    def use(self) -> np.ndarray:
        """Observations [M] (bool) of known points, believed, in frames with a pose."""
        return self.good & self.known[self.track] & self.posed[self.frame]

    def triangulate(self) -> None:
        """Place the points of all tracks that do not have one but have rays enough."""
        rows = self.good & ~self.known[self.track] & self.posed[self.frame]
        for _ in range(2):
            points, fine = self._triangulated(rows)
            error = np.full(len(rows), np.inf)
            error[rows] = np.linalg.norm(self._project(points, rows) - self.pixels[rows], axis=1)
            rows &= (error < self.config.keep_error) & fine[self.track]
        seen = np.bincount(self.track[rows], minlength=len(self.points))
        new = fine & (seen >= self.config.least_observations) & ~self.known
        self.points[new] = points[new]
        self.known |= new
        tried = self.posed[self.frame] & new[self.track]
        self.good[tried] = rows[tried]

    def _triangulated(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points [N, 3] nearest to the rays of `rows` [M] (bool), and which [N] have an angle to stand on."""
        origin, direction = self._rays(rows)
        track, count = self.track[rows], len(self.points)
        across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
        matrix = np.zeros((count, 3, 3))
        right = np.zeros((count, 3))
        np.add.at(matrix, track, across)
        np.add.at(right, track, np.einsum("mij,mj->mi", across, origin))
        mean = np.zeros((count, 3))
        np.add.at(mean, track, direction)
        seen = np.bincount(track, minlength=count)
        mean /= np.linalg.norm(mean, axis=1, keepdims=True).clip(1e-9)
        cosine = np.ones(count)
        np.minimum.at(cosine, track, (direction * mean[track]).sum(1))
        fine = (seen >= 2) & (cosine < np.cos(np.radians(0.5 * self.config.least_angle)))
        matrix[~fine] = np.eye(3)
        return np.linalg.solve(matrix, right[..., None])[..., 0], fine

    def _rays(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Camera centres and unit viewing rays [m, 3] of observations, in the object frame."""
        rotation, transl = self.rotations[self.frame[rows]], self.transl[self.frame[rows]]
        cam = np.concatenate([self.pixels[rows], np.ones((int(rows.sum()), 1))], axis=1)
        cam = cam @ np.linalg.inv(self.K).T
        direction = np.einsum("mji,mj->mi", rotation, cam / np.linalg.norm(cam, axis=1, keepdims=True))
        return -np.einsum("mji,mj->mi", rotation, transl), direction

    def reproject(self, rows: np.ndarray) -> np.ndarray:
        """Where the points of the observations `rows` [M] (bool) appear in their frames, [m, 2] pixels."""
        return self._project(self.points, rows)

    def _project(self, points: np.ndarray, rows: np.ndarray) -> np.ndarray:
        t = self.frame[rows]
        cam = np.einsum("mij,mj->mi", self.rotations[t], points[self.track[rows]]) + self.transl[t]
        depth = np.where(cam[:, 2] > 1e-6, cam[:, 2], 1e-6)
        return cam[:, :2] / depth[:, None] * (self.K[0, 0], self.K[1, 1]) + self.K[:2, 2]

    def judge(self) -> None:
        """Believe the observations near their point's projection; forget points with fewer than two left."""
        rows = self.known[self.track] & self.posed[self.frame]
        error = np.linalg.norm(self.reproject(rows) - self.pixels[rows], axis=1)
        self.good[rows] = error < self.config.keep_error
        seen = np.bincount(self.track[self.use()], minlength=len(self.points))
        self.known &= seen >= 2

    def replace_observations(
        self, frame: np.ndarray, track: np.ndarray, pixels: np.ndarray, covariances: np.ndarray
    ) -> None:
        """Take other observations: [M], [M], [M, 2] and the covariances [M, 2, 2] of their pixels.

        They are no features, so `search` knows none.
        """
        self.frame, self.track, self.pixels = frame, track, pixels
        inverses = self.config.bundle.pixel_sigma**2 * np.linalg.inv(covariances)
        self.precision = inverses[:, [0, 0, 1], [0, 1, 1]]
        self.feature = np.full(len(frame), -1)
        self.good = np.ones(len(frame), dtype=bool)

    def bundle(self, frames: np.ndarray) -> tuple[Bundle, np.ndarray]:
        """Consecutive `frames` with what they see, and the tracks [n] that its points belong to."""
        inside = np.zeros(len(self.posed), dtype=bool)
        inside[frames] = True
        rows = self.use() & inside[self.frame]
        tracks, point = np.unique(self.track[rows], return_inverse=True)
        bundle = Bundle(
            self.rotations[frames],
            self.transl[frames],
            self.points[tracks],
            self.frame[rows] - frames[0],
            point,
            self.pixels[rows],
            self.precision[rows],
        )
        return bundle, tracks

    def adjust(self, frames: np.ndarray, free: np.ndarray, config: BundleConfig) -> None:
        """Bundle adjustment of consecutive `frames` [F], of which `free` [F] (bool) may move."""
        bundle, tracks = self.bundle(frames)
        if len(tracks) == 0 and self.anchor is None:
            return
        anchor = self.anchor
        if anchor is not None:
            rotations, transl, trust = (values[frames] for values in anchor[:3])
            anchor = anchor._replace(rotations=rotations, transl=transl, trust=trust)
        bundle = adjust(bundle, self.K, config, free=free, anchor=anchor)
        self.rotations[frames], self.transl[frames] = bundle.rotations, bundle.transl
        self.points[tracks] = bundle.points

    def search(self, t: int) -> int:
        """Look in frame `t` for known points that should be there; the number of observations found."""
        features, config = self.features[t], self.config
        if len(features.pixels) == 0:
            return 0
        rows = self.use()
        here = np.zeros(len(self.points), dtype=bool)
        here[self.track[self.good & (self.frame == t)]] = True
        taken = np.zeros(len(features.pixels), dtype=bool)
        taken[self.feature[self.good & (self.frame == t) & self.known[self.track]]] = True
        # The observation from the most similar direction represents its point.
        rows &= ~here[self.track]
        if not rows.any() or taken.all():
            return 0
        origin, _ = self._rays(rows)
        towards = origin - self.points[self.track[rows]]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        eye = -self.rotations[t].T @ self.transl[t] - self.points[self.track[rows]]
        eye /= np.linalg.norm(eye, axis=1, keepdims=True)
        cosine = (towards * eye).sum(1)
        index = np.flatnonzero(rows)
        order = np.argsort(-cosine, kind="stable")
        tracks, best = np.unique(self.track[index[order]], return_index=True)
        best = order[best]
        near = cosine[best] > np.cos(np.radians(config.search_angle))
        tracks, best = tracks[near], index[best[near]]
        cam = self.points[tracks] @ self.rotations[t].T + self.transl[t]
        pixels = cam[:, :2] / cam[:, 2:] * (self.K[0, 0], self.K[1, 1]) + self.K[:2, 2]
        new, found = self._recognised(t, tracks, best, pixels, np.flatnonzero(~taken))
        if len(new):
            # An observation of another track that is not triangulated gives way.
            other = (self.frame == t) & np.isin(self.feature, new)
            self.good[other] = False
            self.frame = np.concatenate([self.frame, np.full(len(new), t)])
            self.feature = np.concatenate([self.feature, new])
            self.track = np.concatenate([self.track, found])
            self.pixels = np.concatenate([self.pixels, features.pixels[new]])
            self.precision = np.concatenate([self.precision, alike(len(new))])
            self.good = np.concatenate([self.good, np.ones(len(new), dtype=bool)])
        return len(new)

    def _recognised(
        self, t: int, tracks: np.ndarray, speaks: np.ndarray, pixels: np.ndarray, free: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Features [n] of frame `t` out of `free`, and the one of `tracks` [m] that each shows.

        Args:
            t: the frame.
            tracks: [m] known points.
            speaks: [m] the observation of each that its descriptor is taken from.
            pixels: [m, 2] where they should appear.
            free: features that show no known point yet.
        """
        features, config = self.features[t], self.config
        tree = scipy.spatial.cKDTree(features.pixels[free])
        near = tree.query(pixels, k=_CANDIDATES, distance_upper_bound=config.search_radius)[1]
        wanted = np.array(
            [
                self.features[s].descriptors[i]
                for s, i in zip(self.frame[speaks], self.feature[speaks], strict=True)
            ]
        ).reshape(-1, features.descriptors.shape[1])
        row, column = np.nonzero(near < len(free))
        feature = free[near[row, column]]
        dots = np.einsum(
            "nd,nd->n", features.descriptors[feature].astype(np.float32), wanted[row].astype(np.float32)
        )
        angles = np.full((len(tracks), _CANDIDATES), np.inf)
        angles[row, column] = np.arccos(np.clip(dots / 512.0**2, -1.0, 1.0))
        least = angles.argmin(1)
        every = np.arange(len(tracks))
        angle = angles[every, least]
        angles[every, least] = np.inf
        fits = (angle < config.search_descriptor) & (angle <= config.search_ratio * angles.min(1))
        # If several points claim a feature, the most similar one gets it.
        order = np.flatnonzero(fits)[np.argsort(angle[fits], kind="stable")]
        new, first = np.unique(free[near[order, least[order]]], return_index=True)
        return new, tracks[order[first]]


# Number of features near a point's projection that are compared.
_CANDIDATES = 16

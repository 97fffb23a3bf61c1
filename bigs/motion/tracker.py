"""An object's motion from the tracks in its pictures, where poses are known roughly and not all are right.

The poses say which frames look alike and where to begin, so nothing has to be mapped from nothing: features,
matches, followed features, triangulation, robust adjustment, and patches measured anew. The poses that were
given stay in the adjustment as measurements of their own, as uncertain as they prove to be where tracks know
better. So a frame goes by whichever is surer, and one that shows nothing keeps what it had.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import torch
from scipy.spatial.transform import Rotation, Slerp

from bigs.geometry.rotations import robust_mean_rotation
from bigs.motion.bundle import Anchor, BundleConfig, pose_covariances
from bigs.motion.features import FeatureConfig, FrameFeatures, extract_features
from bigs.motion.focal import FocalConfig, believed_focal, scaled_focal
from bigs.motion.follow import FollowConfig, follow
from bigs.motion.models import MappingConfig, match_features
from bigs.motion.object_map import MapConfig, ObjectMap
from bigs.motion.patches import PatchConfig, Pictures, sharpen
from bigs.motion.points import color_points, sure_sightings, trim_points
from bigs.motion.refine import polish
from bigs.motion.tracks import Tracks, join_matches

Matches = Mapping[tuple[int, int], np.ndarray]


@dataclass(frozen=True)
class TrackerConfig:
    """How tracks are found and weighed."""

    # Poses are roughly known, so half as many features suffice, and patches locate them again in any case.
    features: FeatureConfig = field(default_factory=lambda: FeatureConfig(first_octave=0))
    matching: MappingConfig = field(default_factory=MappingConfig)
    follow: FollowConfig = field(default_factory=FollowConfig)
    map: MapConfig = field(default_factory=MapConfig)
    patches: PatchConfig = field(default_factory=lambda: PatchConfig(passes=2))
    focal: FocalConfig = field(default_factory=FocalConfig)
    # Each frame is matched with this many later ones, ...
    overlap: int = 6
    # ... and with up to this many others whose rotation differs by less than this, degrees.
    alike: int = 3
    alike_angle: float = 25.0
    # An observation contradicts its frame's given pose if it is off by this many times the usual error and by
    # this many pixels.
    contradiction: float = 4.0
    least_contradiction: float = 8.0
    # Frames that share features differ by no more than this rotation, degrees.
    most_turned: float = 50.0
    # Factors on the map's scales in pixels, starting from the given poses' errors.
    reaches: tuple[float, ...] = (8.0, 3.0, 1.0)
    rounds: int = 1
    # Prior errors of given poses: degrees, and shares of the depth, across the ray and along it.
    turn_sigma: float = 3.0
    shift_sigma: tuple[float, float] = (0.015, 0.03)
    # Errors of observations are correlated: true errors are about this many times those of independent ones.
    caution: float = 3.0
    # Up to this factor where poses leave the given ones for long by this many of their standard deviations.
    most_caution: float = 48.0
    most_departure: float = 2.5
    # Errors of neighbouring given poses are correlated too: smoothing them alone makes them no more certain.
    given_caution: float = 3.0
    # A frame with fewer observations says nothing about the given poses' errors.
    least_observations: int = 30


class GivenPoses(NamedTuple):
    """The object to the camera, x_cam = rotations x + transl, metres, x about the object's middle."""

    rotations: np.ndarray  # [T, 3, 3]
    transl: np.ndarray  # [T, 3]
    trust: np.ndarray  # [T] in [0, 1]


class TrackedMotion(NamedTuple):
    """The result, in the given object frame."""

    rotations: np.ndarray  # [T, 3, 3]
    transl: np.ndarray  # [T, 3]
    covariance: np.ndarray  # [T, 6, 6] of rotation (radians) and shift (metres) in the camera's axes
    observations: np.ndarray  # [T] number of points in each frame
    contradicted: np.ndarray  # [T] bool: matches contradict the given pose
    points: np.ndarray  # [N, 3] metres
    colors: np.ndarray  # [N, 3] uint8
    sightings: np.ndarray  # [M, 2] frame and index of each sighting of the points whose place is sure
    turn_sigma: float  # estimated error of the given rotations, radians
    shift_sigma: np.ndarray  # [3] the same of positions, metres
    focal: float  # factor on the given focal length; all the above is seen through the longer or shorter one
    focal_sigma: float  # its standard deviation


def track(
    images: Sequence[np.ndarray],
    masks: np.ndarray,
    K: np.ndarray,
    given: GivenPoses,
    config: TrackerConfig,
) -> TrackedMotion:
    """The object's motion from its pictures and its given poses.

    Args:
        images: T arrays [H, W, 3] uint8.
        masks: [T, H, W] bool, the object's pixels.
        K: [3, 3] intrinsics.
        given: poses; those of frames with `trust` 0 only fill a gap.
        config: see there.
    """
    features = extract_features(images, masks, config.features)
    pairs = pairs_to_match(given, config)
    matches = match_features(features, K, (masks.shape[2], masks.shape[1]), pairs, config.matching)
    features, matches = follow(features, matches, images, masks, config.follow)
    return track_matches(features, matches, images, masks, K, given, config)


def track_matches(
    features: Sequence[FrameFeatures],
    matches: Matches,
    images: Sequence[np.ndarray],
    masks: np.ndarray,
    K: np.ndarray,
    given: GivenPoses,
    config: TrackerConfig,
) -> TrackedMotion:
    """The same from given features and matches."""
    tracks = join_matches(matches, [len(frame.pixels) for frame in features])
    contradicted = contradicted_frames(features, tracks, K, given, config)
    start = _bridged(given, contradicted)
    map_ = ObjectMap(features, tracks, K, config.map)
    map_.anchor = _first_anchor(start, contradicted, config)
    frames = np.arange(len(features))
    map_.restart(frames, start.rotations, start.transl)
    map_.settle(config.reaches)
    polish(map_, config.rounds)
    sharpen(map_, Pictures(images, masks, config.patches), config.patches)

    focal = believed_focal(map_.bundle(frames)[0], K, config.map.bundle, config.focal)
    K = scaled_focal(K, focal.factor)
    map_.change_camera(K, focal.factor)
    map_.anchor = measured_anchor(map_, map_.anchor, config)
    uncertain = _fused(map_, config)
    bundle, _ = map_.bundle(frames)
    doubted = map_.anchor._replace(
        turn_sigma=config.given_caution * map_.anchor.turn_sigma,
        shift_sigma=config.given_caution * map_.anchor.shift_sigma,
    )
    covariance = pose_covariances(bundle, K, uncertain, doubted)
    seen = np.bincount(map_.track[map_.use()], minlength=len(map_.points))
    used = np.flatnonzero(map_.known & (seen >= config.map.least_observations))
    if len(used):
        used = used[trim_points(map_.points[used])]
    colors = color_points(map_, used, images) if len(used) else np.zeros((0, 3), dtype=np.uint8)
    return TrackedMotion(
        map_.rotations,
        map_.transl,
        covariance,
        np.bincount(map_.frame[map_.use()], minlength=len(frames)),
        contradicted,
        map_.points[used],
        colors,
        sure_sightings(map_, used),
        map_.anchor.turn_sigma,
        map_.anchor.shift_sigma,
        focal.factor,
        focal.sigma,
    )


def _fused(map_: ObjectMap, config: TrackerConfig) -> BundleConfig:
    """Adjust everything with the given poses, in place; what was believed of observations in the end.

    Where few points lead across, tracks may bend and be sure of it. Given poses err, too, but not for many
    frames by more than they ever do: then observations are believed less, until both agree. The weakest links
    give way first.
    """
    assert map_.anchor is not None
    everything = np.ones(len(map_.posed), dtype=bool)
    caution, scales = config.caution, config.map.bundle
    while True:
        # A lasting departure is no outlier of the given poses.
        believed = replace(
            scales,
            pixel_sigma=caution * scales.pixel_sigma,
            anchor_outlier=caution / config.caution * scales.anchor_outlier,
            iterations=30,
        )
        map_.adjust(np.arange(len(everything)), everything, believed)
        bent = sustained_departure(map_.rotations, map_.anchor) > config.most_departure
        if not bent or caution >= config.most_caution:
            return believed
        caution *= 2.0


def sustained_departure(rotations: np.ndarray, anchor: Anchor) -> float:
    """By how many of their standard deviations turns [T, 3, 3] leave the anchor's for some time, at most.

    Medians over windows of frames, after the one turn of the object's frame that suits most.
    """
    use = np.flatnonzero(anchor.trust > 0.5)
    if len(use) < _WINDOW:
        return 0.0
    between = rotations[use].transpose(0, 2, 1) @ anchor.rotations[use]
    usual = robust_mean_rotation(torch.from_numpy(between)).numpy()
    turns = Rotation.from_matrix(between @ usual.T).as_rotvec()
    windows = np.lib.stride_tricks.sliding_window_view(turns, _WINDOW, axis=0)
    return float(np.linalg.norm(np.median(windows, axis=-1), axis=1).max() / anchor.turn_sigma)


def pairs_to_match(given: GivenPoses, config: TrackerConfig) -> list[tuple[int, int]]:
    """Neighbours, and for each frame those others that show the object from nearly the same side."""
    frames = len(given.rotations)
    pairs = {(a, b) for a in range(frames) for b in range(a + 1, min(a + 1 + config.overlap, frames))}
    # A rotation about the camera's own axis does not change which side it sees.
    views = _views(given)
    cosine = views @ views.T
    for a in range(frames):
        away = np.flatnonzero(np.abs(np.arange(frames) - a) > config.overlap)
        nearest = away[np.argsort(-cosine[a, away], kind="stable")[: config.alike]]
        for b in nearest[cosine[a, nearest] > np.cos(np.radians(config.alike_angle))]:
            pairs.add((min(a, int(b)), max(a, int(b))))
    return sorted(pairs)


def _views(given: GivenPoses) -> np.ndarray:
    """Directions [T, 3] from the object towards the camera, in the object's frame."""
    eyes = -np.einsum("tji,tj->ti", given.rotations, given.transl)
    return eyes / np.linalg.norm(eyes, axis=1, keepdims=True)


def contradicted_frames(
    features: Sequence[FrameFeatures],
    tracks: Tracks,
    K: np.ndarray,
    given: GivenPoses,
    config: TrackerConfig,
) -> np.ndarray:
    """Frames [T] (bool) whose observations, together with those of other frames, refute their given pose.

    Each track's point is placed where most of its rays meet. Two frames agree if most tracks that they share
    have both on their point. The largest set of frames that agreement connects is believed, and so are frames
    that share too little with any. (Two frames alone tell nothing: through a long lens their epipolar lines
    are the same whatever the angle that the object turned by.)
    """
    frames = len(features)
    seen = np.bincount(tracks.track, minlength=tracks.total)
    rows = seen[tracks.track] >= _LEAST_RAYS
    if not rows.any():
        return np.zeros(frames, dtype=bool)
    frame = tracks.frame[rows]
    _, point = np.unique(tracks.track[rows], return_inverse=True)
    pixels = np.array([features[t].pixels[i] for t, i in zip(frame, tracks.feature[rows], strict=True)])
    off = _off_their_points(frame, point, pixels, K, given)
    on = off < max(config.contradiction * float(np.median(off)), config.least_contradiction)
    everything = np.ones(len(frame))
    shape = (frames, int(point.max()) + 1)
    shown = scipy.sparse.csr_matrix((everything, (frame, point)), shape=shape)
    agreeing = scipy.sparse.csr_matrix((everything[on], (frame[on], point[on])), shape=shape)
    shared = (shown @ shown.T).toarray()
    agreed = (agreeing @ agreeing.T).toarray()
    speaks = shared >= config.matching.pair_inliers
    np.fill_diagonal(speaks, False)
    # Features are not found again beyond this rotation.
    views = _views(given)
    good = speaks & (agreed > 0.5 * shared) & (views @ views.T > np.cos(np.radians(config.most_turned)))
    _, label = scipy.sparse.csgraph.connected_components(scipy.sparse.csr_matrix(good), directed=False)
    believed = label == np.bincount(label).argmax()
    return ~believed & (speaks & ~good)[:, believed].any(1)


def _off_their_points(
    frame: np.ndarray, point: np.ndarray, pixels: np.ndarray, K: np.ndarray, given: GivenPoses
) -> np.ndarray:
    """How far each observation [M] is from where most rays of its track meet, pixels."""
    rotation, transl = given.rotations[frame], given.transl[frame]
    ray = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ np.linalg.inv(K).T
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    ray = np.einsum("mji,mj->mi", rotation, ray)
    eye = -np.einsum("mji,mj->mi", rotation, transl)
    across = (np.eye(3) - ray[:, :, None] * ray[:, None, :]).reshape(-1, 9)
    aim = np.einsum("mij,mj->mi", across.reshape(-1, 3, 3), eye)
    per_metre = K[0, 0] / np.median(given.transl[:, 2])
    count = int(point.max()) + 1
    gather = scipy.sparse.csr_matrix(
        (np.ones(len(point)), (point, np.arange(len(point)))), (count, len(point))
    )
    # Points lie in the object, which keeps those in place whose rays are nearly parallel.
    hold = 1e-3 * np.eye(3)
    weight = np.ones(len(point))
    # From a scale at which all rays count to one at which most agree.
    for scale in (100.0, 60.0, 40.0, 25.0, 15.0, 10.0, 10.0):
        matrix = (gather @ (weight[:, None] * across)).reshape(-1, 3, 3) + hold
        places = np.linalg.solve(matrix, (gather @ (weight[:, None] * aim))[..., None])[..., 0]
        away = np.einsum("mij,mj->mi", across.reshape(-1, 3, 3), places[point]) - aim
        off = per_metre * np.linalg.norm(away, axis=1)
        weight = 1.0 / (1.0 + (off / scale) ** 2) ** 2
    return off


def _bridged(given: GivenPoses, out: np.ndarray) -> GivenPoses:
    """The poses with those of the frames `out` interpolated between their neighbours."""
    if not out.any() or (~out).sum() < 2:
        return given
    kept, lost = np.flatnonzero(~out), np.flatnonzero(out)
    at = np.clip(lost, kept[0], kept[-1])
    rotations, transl = given.rotations.copy(), given.transl.copy()
    rotations[lost] = Slerp(kept, Rotation.from_matrix(given.rotations[kept]))(at).as_matrix()
    transl[lost] = np.stack([np.interp(at, kept, given.transl[kept, i]) for i in range(3)], axis=1)
    return GivenPoses(rotations, transl, np.where(out, 0.0, given.trust))


def _first_anchor(given: GivenPoses, out: np.ndarray, config: TrackerConfig) -> Anchor:
    depth = float(np.median(given.transl[:, 2]))
    across, along = config.shift_sigma
    return Anchor(
        given.rotations,
        given.transl,
        np.where(out, 0.0, given.trust),
        np.radians(config.turn_sigma),
        depth * np.array([across, across, along]),
    )


def measured_anchor(map_: ObjectMap, anchor: Anchor, config: TrackerConfig) -> Anchor:
    """The anchor, as uncertain as it is in the frames that tracks know well.

    Departures are counted after the one turn, shift and growth of the object's frame that suits most, since
    these change no picture.
    """
    seen = np.bincount(map_.frame[map_.use()], minlength=len(map_.posed))
    use = (seen >= config.least_observations) & (anchor.trust > 0.5)
    if use.sum() < _FEWEST:
        return anchor
    rotations, transl = map_.rotations[use], map_.transl[use]
    between = rotations.transpose(0, 2, 1) @ anchor.rotations[use]
    usual = robust_mean_rotation(torch.from_numpy(between)).numpy()
    turns = Rotation.from_matrix(between @ usual.T).as_rotvec()
    # given = growth * transl + R shift, robustly.
    columns = np.concatenate([transl[:, :, None], rotations], axis=2)
    weight = np.ones(len(transl))
    for _ in range(10):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(
            (root[:, :, None] * columns).reshape(-1, 4), (root * anchor.transl[use]).ravel(), rcond=None
        )[0]
        shifts = anchor.transl[use] - columns @ solution
        weight = 1.0 / np.linalg.norm(shifts, axis=1).clip(1e-6)
    spread = 1.4826 * np.median(np.abs(shifts), axis=0)
    across = float(np.sqrt((spread[:2] ** 2).mean()))
    return anchor._replace(
        turn_sigma=max(1.4826 * float(np.median(np.abs(turns))), _LEAST_TURN),
        shift_sigma=np.array([across, across, spread[2]]).clip(_LEAST_SHIFT * transl[:, 2].mean()),
    )


# Frames over which a departure is sustained.
_WINDOW = 9
# Fewer rays always meet nearly enough.
_LEAST_RAYS = 4
# Fewer frames do not measure an error.
_FEWEST = 10
# Poses are never believed to be more accurate than this: radians, and shares of the depth.
_LEAST_TURN = 5e-4
_LEAST_SHIFT = 2e-4

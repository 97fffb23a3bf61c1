"""An object's motion from the tracks in its pictures, where poses are known roughly and not all are right.

The poses say which frames look alike and where to begin, so nothing has to be mapped from nothing: features,
matches, followed features, triangulation, robust adjustment, and patches measured anew. The poses that were
given stay in the adjustment as measurements of their own, as uncertain as they prove to be where tracks know
better. So a frame goes by whichever is surer, and one that shows nothing keeps what it had.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bigs.geometry.rotations import robust_mean_rotation
from bigs.motion.bundle import Anchor, BundleConfig, pose_covariances
from bigs.motion.features import FrameFeatures, extract_features
from bigs.motion.focal import believed_focal, scaled_focal
from bigs.motion.follow import follow
from bigs.motion.given_poses import GivenPoses, bridged, contradicted_frames, pairs_to_match
from bigs.motion.masks import without_gaps
from bigs.motion.models import match_features
from bigs.motion.object_map import ObjectMap
from bigs.motion.patches import Pictures, sharpen
from bigs.motion.points import color_points, sure_sightings, trim_points
from bigs.motion.refine import polish
from bigs.motion.tracker_config import TrackerConfig
from bigs.motion.tracks import join_matches

Matches = Mapping[tuple[int, int], np.ndarray]


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
    masks = without_gaps(masks)
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
    start = bridged(given, contradicted)
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
    spread_of_turns = 1.4826 * float(np.median(np.abs(turns)))
    return anchor._replace(
        turn_sigma=float(np.clip(spread_of_turns, _LEAST_TURN, np.radians(config.most_turn_sigma))),
        shift_sigma=np.array([across, across, spread[2]]).clip(_LEAST_SHIFT * transl[:, 2].mean()),
    )


# Frames over which a departure is sustained.
_WINDOW = 9
# Fewer frames do not measure an error.
_FEWEST = 10
# Poses are never believed to be more accurate than this: radians, and shares of the depth.
_LEAST_TURN = 5e-4
_LEAST_SHIFT = 2e-4

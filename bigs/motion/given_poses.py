"""Poses that were given: which frames they say look alike, and which of them the tracks refute."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from scipy.spatial.transform import Rotation, Slerp

from bigs.motion.features import FrameFeatures
from bigs.motion.tracker_config import TrackerConfig
from bigs.motion.tracks import Tracks


class GivenPoses(NamedTuple):
    """The object to the camera, x_cam = rotations x + transl, metres, x about the object's middle."""

    rotations: np.ndarray  # [T, 3, 3]
    transl: np.ndarray  # [T, 3]
    trust: np.ndarray  # [T] in [0, 1]


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


def bridged(given: GivenPoses, out: np.ndarray) -> GivenPoses:
    """The poses with those of the frames `out` interpolated between their neighbours."""
    if not out.any() or (~out).sum() < 2:
        return given
    kept, lost = np.flatnonzero(~out), np.flatnonzero(out)
    at = np.clip(lost, kept[0], kept[-1])
    rotations, transl = given.rotations.copy(), given.transl.copy()
    rotations[lost] = Slerp(kept, Rotation.from_matrix(given.rotations[kept]))(at).as_matrix()
    transl[lost] = np.stack([np.interp(at, kept, given.transl[kept, i]) for i in range(3)], axis=1)
    return GivenPoses(rotations, transl, np.where(out, 0.0, given.trust))


# Fewer rays always meet nearly enough.
_LEAST_RAYS = 4

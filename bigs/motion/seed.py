"""The start of a map: a run of one model's frames that moves smoothly, in the better of two mirror images.

Through a long lens an object that turns one way looks nearly like its mirror image in depth that turns the
other way, and structure from motion may settle on either. Only the perspective tells them apart, so both are
adjusted and compared.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.motion.models import PartialModel
from bigs.motion.object_map import ObjectMap

_FLIP = np.diag([1.0, 1.0, -1.0])

# A larger change of angular velocity within one frame is an error, degrees.
_KINK = 2.5


class Seed(NamedTuple):
    """Poses of consecutive frames."""

    frames: np.ndarray  # [F]
    rotations: np.ndarray  # [F, 3, 3]
    transl: np.ndarray  # [F, 3], positions of the middle of the points
    misfit: float  # misfit of the map grown from these frames alone
    mirror_misfit: float  # misfit of their mirror image


def mirrored(rotations: np.ndarray) -> np.ndarray:
    """The rotations [F, 3, 3] of the mirror image in depth."""
    return _FLIP @ rotations @ _FLIP


def find_seed(map_: ObjectMap, model: PartialModel) -> Seed | None:
    """The longest smooth run of `model`, adjusted, in the better mirror image; None if it is too short.

    `map_` is used to try it and left with the seed's poses and points.
    """
    run = smooth_runs(model.frames, model.rotations)[0]
    if len(run) < 3:
        return None
    middle = np.median(model.points, axis=0)
    transl = model.transl + model.rotations @ middle
    tried = []
    for rotations in (model.rotations[run], mirrored(model.rotations[run])):
        map_.restart(model.frames[run], rotations, transl[run])
        map_.settle()
        frames = model.frames[run]
        tried.append((map_.misfit(), map_.rotations[frames].copy(), map_.transl[frames].copy()))
    better, worse = sorted(tried, key=lambda entry: entry[0])
    seed = Seed(model.frames[run], better[1], better[2], better[0], worse[0])
    map_.restart(seed.frames, seed.rotations, seed.transl)
    map_.settle()
    return seed


def smooth_runs(frames: np.ndarray, rotations: np.ndarray) -> list[np.ndarray]:
    """Which entries of a model form runs of consecutive frames that turn without a kink, longest first."""
    if len(frames) < 3:
        return [np.arange(len(frames))]
    steps = Rotation.from_matrix(rotations[1:] @ rotations[:-1].transpose(0, 2, 1))
    velocity = steps.as_rotvec(degrees=True) / np.diff(frames)[:, None]
    kink = np.linalg.norm(np.diff(velocity, axis=0), axis=1) > _KINK
    # Missing frames break a run; a kink ends it at its middle.
    broken = np.diff(frames) > 1
    cut = broken.copy()
    cut[1:] |= kink
    cut[:-1] |= kink
    return sorted(np.split(np.arange(len(frames)), np.flatnonzero(cut) + 1), key=len, reverse=True)


def mirror_preference(map_: ObjectMap, frames: np.ndarray) -> float:
    """By how many standard deviations consecutive `frames` fit better than their mirror image in depth.

    `map_` is changed; give a copy.
    """
    rotations, transl = map_.rotations[frames].copy(), map_.transl[frames].copy()
    return preference(map_, frames, (rotations, transl), (mirrored(rotations), transl))[0]


def preference(
    map_: ObjectMap,
    frames: np.ndarray,
    poses: tuple[np.ndarray, np.ndarray],
    others: tuple[np.ndarray, np.ndarray],
) -> tuple[float, np.ndarray, np.ndarray]:
    """By how many standard deviations consecutive `frames` fit better at `poses` than at `others`.

    Both are adjusted by themselves, and the tracks' losses compared one by one: what fits neither, as many
    observations do on plain objects, says nothing, and many tracks that say a little say it surely. 0 if no
    track fits either. `map_` is changed; give a copy.

    Returns:
        The preference, and the rotations [F, 3, 3] that both came to.
    """
    losses, came_to = [], []
    for rotations, transl in (poses, others):
        map_.restart(frames, rotations, transl)
        map_.settle()
        losses.append(map_.losses())
        came_to.append(map_.rotations[frames].copy())
    better = losses[1] - losses[0]
    spread = float(np.linalg.norm(better))
    return float(better.sum()) / spread if spread > 0 else 0.0, came_to[0], came_to[1]

"""Growing one trusted model over the whole clip: frame by frame, each start predicted by the motion so far.

A second model that is begun from nothing may come out with its depth reversed, and its size is unknown. A
frame that is added here starts from where the motion leads, sees points whose depth is known, and is held by
the motion prior while few are left; points that come into view are placed from poses that exist.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.motion.bundle import BundleConfig
from bigs.motion.models import PartialModel
from bigs.motion.object_map import ObjectMap
from bigs.motion.refine import joined


@dataclass(frozen=True)
class GrowConfig:
    """How frames are added."""

    # Number of frames that are adjusted together with a new one, and of those that may still move.
    window: int = 10
    moving: int = 4
    # Velocity is the mean over this many steps.
    memory: int = 4
    # Scales of a new frame's reprojection errors while it finds its place, pixels.
    coarse_sigma: float = 2.0
    iterations: int = 8
    # The motion prior is weaker while growing: each prediction is an extrapolation.
    turn_sigma: float = 0.6
    shift_sigma: float = 0.003


def grow(map_: ObjectMap, models: Sequence[PartialModel], config: GrowConfig) -> None:
    """Give every frame of the clip a pose, in place: next comes the one that sees most known points.

    `models` are partial models, which may know how a frame is turned against the one before where the motion
    does not go on as it was: after a pause, say.
    """
    fine = replace(
        map_.config.bundle,
        turn_sigma=config.turn_sigma,
        shift_sigma=config.shift_sigma,
        iterations=config.iterations,
    )
    while not map_.posed.all():
        t, towards = _next_frame(map_)
        starts = [
            _predicted(map_, t, towards, config.memory),
            # Where a motion reverses, extrapolation is wrong.
            (map_.rotations[t - towards].copy(), map_.transl[t - towards].copy()),
            _turned_back(map_, t, towards),
            *as_models_say(map_, t, towards, models),
        ]
        map_.posed[t] = True
        frames, free = _window(map_, t, towards, config)
        coarse = replace(fine, pixel_sigma=config.coarse_sigma)
        map_.rotations[t], map_.transl[t] = best_start(map_, t, frames, starts, coarse)
        map_.search(t)
        map_.adjust(frames, free & (frames == t), coarse)
        map_.judge()
        map_.search(t)
        map_.adjust(frames, free, fine)
        map_.judge()
        map_.triangulate()


def _next_frame(map_: ObjectMap) -> tuple[int, int]:
    """The frame to add, and the direction in time (+1 or -1) from the poses that lead to it."""
    known = np.bincount(map_.frame[map_.good & map_.known[map_.track]], minlength=len(map_.posed))
    options = [
        (known[t + step], t + step, step)
        for t in np.flatnonzero(map_.posed)
        for step in (1, -1)
        if 0 <= t + step < len(map_.posed) and not map_.posed[t + step]
    ]
    _, t, step = max(options)
    return int(t), step


_Pose = tuple[np.ndarray, np.ndarray]  # [3, 3] and [3]


def _predicted(map_: ObjectMap, t: int, step: int, memory: int) -> _Pose:
    """The pose of frame `t` if the object goes on as in the frames before it (or after it)."""
    before = [t - step]
    while len(before) <= memory and (
        0 <= before[-1] - step < len(map_.posed) and map_.posed[before[-1] - step]
    ):
        before.append(before[-1] - step)
    last = before[0]
    if len(before) == 1:
        return map_.rotations[last], map_.transl[last]
    steps = len(before) - 1
    turns = Rotation.from_matrix(map_.rotations[before[:-1]] @ map_.rotations[before[1:]].transpose(0, 2, 1))
    turn = Rotation.from_rotvec(turns.as_rotvec().mean(0)).as_matrix()
    return turn @ map_.rotations[last], map_.transl[last] + (
        map_.transl[last] - map_.transl[before[-1]]
    ) / steps


def _turned_back(map_: ObjectMap, t: int, step: int) -> _Pose:
    """The pose of frame `t` if it is that of the last frame but one, and else that of the last."""
    two = t - 2 * step
    last = two if 0 <= two < len(map_.posed) and map_.posed[two] else t - step
    return map_.rotations[last].copy(), map_.transl[last].copy()


def as_models_say(map_: ObjectMap, t: int, step: int, models: Sequence[PartialModel]) -> list[_Pose]:
    """The pose of frame `t` by each partial model that has it and the frame it is reached from."""
    starts = []
    for model in models:
        rows = [np.flatnonzero(model.frames == frame) for frame in (t - step, t)]
        if all(len(row) for row in rows):
            rotations, transl = joined(map_, model, np.concatenate(rows))
            starts.append((rotations[t], transl[t]))
    return starts


def best_start(
    map_: ObjectMap, t: int, frames: np.ndarray, starts: Sequence[_Pose], coarse: BundleConfig
) -> _Pose:
    """The start of frame `t` from which the observations of known points fit best; of equals the first.

    Fit is counted by a loss that is fine about small errors: a side that is seen face on looks nearly the
    same whichever way it turns from there.
    """
    rows = map_.good & map_.known[map_.track] & (map_.frame == t)
    points = map_.points.copy()
    losses = []
    for rotation, transl in starts:
        map_.rotations[t], map_.transl[t] = rotation, transl
        map_.adjust(frames, frames == t, coarse)
        squared = ((map_.reproject(rows) - map_.pixels[rows]) ** 2).sum(1)
        losses.append((squared / (squared + coarse.pixel_sigma**2)).sum())
        map_.points = points.copy()
    return starts[int(np.argmin(losses))]


def _window(map_: ObjectMap, t: int, step: int, config: GrowConfig) -> tuple[np.ndarray, np.ndarray]:
    """Consecutive posed frames about `t`, mostly on the side it was reached from, and which may move."""
    lower = upper = t
    while lower > 0 and map_.posed[lower - 1] and t - lower < config.window:
        lower -= 1
    while upper + 1 < len(map_.posed) and map_.posed[upper + 1] and upper - t < config.window:
        upper += 1
    frames = np.arange(lower, upper + 1)
    return frames, (np.abs(frames - t) < config.moving) & ((t - frames) * step >= 0)

"""Signs that object poses are wrong, none of which needs the truth.

The number of frames with a pose and the reprojection error say nothing: a wrong model can have all frames and
a third of a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.motion.bundle import turn_uncertainties
from bigs.motion.features import FrameFeatures
from bigs.motion.models import PartialModel
from bigs.motion.object_map import MapConfig, ObjectMap
from bigs.motion.refine import disagreement, joined, smooth_parts
from bigs.motion.seed import mirror_preference, mirrored, preference
from bigs.motion.tracks import Tracks


@dataclass(frozen=True)
class CheckConfig:
    """When a frame is flagged."""

    # With fewer observations, the pose is the motion prior's.
    least_observations: int = 8
    # Standard deviation of the rotation from the observations alone, degrees.
    most_uncertain: float = 1.0
    # Cosine between the mean angular velocities of the five frames before and after.
    least_cosine: float = 0.8
    # A step longer than this many usual ones, and than this angle, degrees.
    long_step: float = 2.0
    least_long_step: float = 8.0
    # Standard deviations by which a segment must fit better than its mirror image in depth. Right ones had at
    # least 3.5 where little was seen, reversed ones at most 0, and bent ones 1 to 2.
    least_preference: float = 2.5
    # Difference between a partial model's rotations and the map's, degrees.
    most_disagreement: float = 5.0
    # Frames that are compared with their mirror image together; windows overlap by half.
    mirror_window: int = 20


class SfmChecks(NamedTuple):
    """What was found in each frame."""

    observations: np.ndarray  # [T] number of accepted observations
    uncertainty: np.ndarray  # [T] degrees relative to the best connected frame
    mirror: np.ndarray  # [T] preference over the mirror image in the worst window; below 0 is wrong
    cosine: np.ndarray  # [T] cosine of angular velocities before and after; 1 where nothing turns
    flags: list[list[str]]  # T lists of plain words; empty if nothing is wrong

    def doubtful(self) -> np.ndarray:
        """Frames [T] (bool) whose pose should not be relied on."""
        return np.array([bool(set(words) & _SERIOUS) for words in self.flags])


FEW = "few points"
LOOSE = "tied loosely"
REVERSED = "depth may be reversed"
TURN = "turn changes"
STEP = "long step"
OTHERWISE = "models disagree"
# A change of rotation may be real; the others are not.
_SERIOUS = {FEW, LOOSE, REVERSED, STEP, OTHERWISE}


def check_map(
    map_: ObjectMap,
    features: Sequence[FrameFeatures],
    tracks: Tracks,
    models: Sequence[PartialModel],
    config: CheckConfig,
) -> SfmChecks:
    """All checks of a map whose frames all have poses. `tracks` are those of the matches alone."""
    frames = len(map_.posed)
    observations = np.bincount(map_.frame[map_.use()], minlength=frames)
    bundle, _ = map_.bundle(np.arange(frames))
    # The motion prior is nearly removed, so that the observations count.
    loose = replace(map_.config.bundle, turn_sigma=3.0, shift_sigma=0.015)
    between = turn_uncertainties(bundle, map_.K, loose)
    # Of two loosely connected parts the larger one is believed.
    tied = (between <= config.most_uncertain).sum(1)
    uncertainty = between[max(range(frames), key=lambda t: (tied[t], observations[t]))]
    trial = ObjectMap(features, tracks, map_.K, MapConfig())
    mirror = _mirror_preference(map_, trial, config.mirror_window)
    cosine = turn_cosines(map_.rotations)
    steps = _step_angles(map_.rotations)
    usual = float(np.median(steps)) if len(steps) else 0.0
    long_step = np.zeros(frames, dtype=bool)
    for t in np.flatnonzero(steps > max(config.long_step * usual, config.least_long_step)):
        long_step[t : t + 2] = True
    otherwise = np.zeros(frames, dtype=bool)
    for part in smooth_parts(models):
        degrees = disagreement(map_.rotations, part)
        # A model that is the map's mirror image in depth is another start that came out reversed; perspective
        # decides between the two.
        image = part._replace(rotations=mirrored(part.rotations))
        if min(degrees.max(), disagreement(map_.rotations, image).max()) <= config.most_disagreement:
            continue
        if not _outdone(map_, trial, part, config):
            otherwise[part.frames[degrees > config.most_disagreement]] = True
    signs = {
        FEW: observations < config.least_observations,
        LOOSE: uncertainty > config.most_uncertain,
        REVERSED: mirror < config.least_preference,
        TURN: cosine < config.least_cosine,
        STEP: long_step,
        OTHERWISE: otherwise,
    }
    flags = [[word for word, found in signs.items() if found[t]] for t in range(frames)]
    return SfmChecks(observations, uncertainty, mirror, cosine, flags)


def turn_cosines(rotations: np.ndarray, reach: int = 5) -> np.ndarray:
    """Cosine [T] between the mean angular velocities of the `reach` frames before and after each frame.

    1 where either side turns by less than a degree a frame, or has no frames.
    """
    velocity = Rotation.from_matrix(rotations[1:] @ rotations[:-1].transpose(0, 2, 1)).as_rotvec(degrees=True)
    cosine = np.ones(len(rotations))
    for t in range(reach, len(rotations) - reach):
        before, after = velocity[t - reach : t].mean(0), velocity[t : t + reach].mean(0)
        lengths = np.linalg.norm(before), np.linalg.norm(after)
        if min(lengths) > 1.0:
            cosine[t] = before @ after / (lengths[0] * lengths[1])
    return cosine


def _step_angles(rotations: np.ndarray) -> np.ndarray:
    steps = Rotation.from_matrix(rotations[1:] @ rotations[:-1].transpose(0, 2, 1))
    return np.degrees(steps.magnitude())


def _outdone(map_: ObjectMap, trial: ObjectMap, part: PartialModel, config: CheckConfig) -> bool:
    """Whether the observations in a part's frames, taken alone, agree with the map rather than the part."""
    rows = np.arange(len(part.frames))
    poses = map_.rotations[part.frames], map_.transl[part.frames]
    rotations, transl = joined(map_, part, rows)
    better, ours, theirs = preference(
        trial, part.frames, poses, (rotations[part.frames], transl[part.frames])
    )
    off = [disagreement(map_.rotations, part._replace(rotations=turned)).max() for turned in (ours, theirs)]
    # If the part converges to the map as well, there is nothing to choose.
    one = off[1] <= config.most_disagreement
    return off[0] <= config.most_disagreement and (one or better >= config.least_preference)


def _mirror_preference(map_: ObjectMap, trial: ObjectMap, window: int) -> np.ndarray:
    """For each frame, the least over windows of the preference over the mirror image.

    `trial` is a map of the same tracks to try it on.
    """
    frames = len(map_.posed)
    least = np.full(frames, np.inf)
    for start in range(0, max(frames - window // 2, 1), max(window // 2, 1)):
        inside = np.arange(start, min(start + window, frames))
        if len(inside) < 3:
            continue
        trial.rotations[:], trial.transl[:] = map_.rotations, map_.transl
        least[inside] = np.minimum(least[inside], mirror_preference(trial, inside))
    return least

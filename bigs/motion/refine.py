"""A grown map rebuilt from its poses, and with parts of it at the poses of other partial models.

Growing decides early what is a point and what a stray, and bends where little was seen. Adjusted once more
from its poses alone, with every observation believed again, the map forgets that. Where it crossed few
observations it may still be bent; a partial model of the frames beyond, made without crossing them, is then
the better start.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bigs.geometry.rotations import robust_mean_rotation
from bigs.motion.models import PartialModel
from bigs.motion.object_map import ObjectMap
from bigs.motion.seed import smooth_runs
from bigs.motion.tracks import Tracks


@dataclass(frozen=True)
class RefineConfig:
    """The number of rounds, and what is tried in each."""

    passes: int = 2
    # Rounds of full bundle adjustment in each pass.
    rounds: int = 2
    # A partial model whose rotations differ from the map's by more than this is tried in its place, degrees,
    # ...
    disagreement: float = 3.0
    # ... joined to the map at its frame nearest to the start, and this many frames further in.
    depths: tuple[int, ...] = (0, 3)


def refine(
    map_: ObjectMap,
    tracks: Tracks,
    models: Sequence[PartialModel],
    start: np.ndarray,
    config: RefineConfig,
) -> tuple[ObjectMap, float]:
    """The map rebuilt from its own poses, or from those with a partial model spliced in.

    Args:
        map_: with a pose in every frame.
        tracks: of the matches alone.
        models: partial models, among them the one that the map was started from.
        start: [F] frames that it was started from.
        config: see there.

    Returns:
        The new map, and how badly its poses explained the matches alone: maps of other starts compare by it.
    """
    misfit = np.inf
    for _ in range(config.passes):
        best = _made_anew(map_, tracks, map_.rotations, map_.transl)
        misfit = best.misfit()
        for part, rotations, transl in splices(map_, models, start, config):
            anew = _made_anew(map_, tracks, rotations, transl)
            # A model that differs even where the map joins it was wrong itself, and its result is chance.
            agrees = disagreement(anew.rotations, part).max() <= config.disagreement
            if agrees and anew.misfit() < misfit:
                best, misfit = anew, anew.misfit()
        map_ = best
        polish(map_, config.rounds)
    return map_, misfit


def polish(map_: ObjectMap, rounds: int) -> None:
    """Bundle adjustment of everything, with points sought again in all frames between the rounds."""
    frames = np.arange(len(map_.posed))
    everything = np.ones(len(frames), dtype=bool)
    for _ in range(rounds):
        for t in range(len(frames)):
            map_.search(t)
        map_.adjust(frames, everything, map_.config.bundle)
        map_.judge()
        map_.triangulate()


def smooth_parts(models: Iterable[PartialModel]) -> list[PartialModel]:
    """The poses of partial models in their smooth runs: what they say beyond a kink is another matter.

    Short runs and models of few points are left out: such are often wrong themselves.
    """
    return [
        model._replace(frames=model.frames[run], rotations=model.rotations[run], transl=model.transl[run])
        for model in models
        if len(model.points) >= _FEWEST_POINTS
        for run in smooth_runs(model.frames, model.rotations)
        if len(run) >= _FEWEST_FRAMES
    ]


def disagreement(rotations: np.ndarray, part: PartialModel) -> np.ndarray:
    """By how much a partial model's F frames are turned against the poses [T, 3, 3].

    Returns:
        Degrees [F] after the one turn of its frame that suits most of them.
    """
    between = part.rotations.transpose(0, 2, 1) @ rotations[part.frames]
    usual = robust_mean_rotation(torch.from_numpy(between)).numpy()
    return np.degrees(Rotation.from_matrix(between @ usual.T).magnitude())


_FEWEST_FRAMES = 5
_FEWEST_POINTS = 30


def _made_anew(map_: ObjectMap, tracks: Tracks, rotations: np.ndarray, transl: np.ndarray) -> ObjectMap:
    anew = ObjectMap(map_.features, tracks, map_.K, map_.config)
    anew.restart(np.arange(len(rotations)), rotations, transl)
    anew.settle()
    return anew


class Splice(NamedTuple):
    """Poses of all frames, with those of a partial model in place of the map's."""

    part: PartialModel
    rotations: np.ndarray  # [T, 3, 3]
    transl: np.ndarray  # [T, 3]


def splices(
    map_: ObjectMap, models: Sequence[PartialModel], start: np.ndarray, config: RefineConfig
) -> Iterable[Splice]:
    """What comes of putting each smooth part of a model that disagrees with the map in its place.

    Arguments as for `refine`; nothing where all models agree.
    """
    for part in smooth_parts(models):
        agrees = disagreement(map_.rotations, part).max() <= config.disagreement
        if agrees or np.isin(part.frames, start).any():
            continue
        # From the frame nearest to the start outwards.
        order = np.argsort(np.abs(part.frames[:, None] - start).min(1), kind="stable")
        for depth in config.depths:
            if depth < len(order):
                yield Splice(part, *joined(map_, part, order[depth:]))


def joined(map_: ObjectMap, model: PartialModel, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The map's poses with those of `model`'s frames `rows`, in the map's frame and size.

    At the first of `rows` both agree in pose and in the depth of the object's middle.
    """
    at = int(model.frames[rows[0]])
    middle = np.median(map_.points[map_.known], axis=0)
    place = model.transl + model.rotations @ np.median(model.points, axis=0)
    size = (map_.transl[at] + map_.rotations[at] @ middle)[2] / place[rows[0], 2]
    turn = map_.rotations[at].T @ model.rotations[rows[0]]
    shift = map_.rotations[at].T @ (size * place[rows[0]] - map_.transl[at])
    rotations, transl = map_.rotations.copy(), map_.transl.copy()
    frames = model.frames[rows]
    rotations[frames] = model.rotations[rows] @ turn.T
    transl[frames] = size * place[rows] - rotations[frames] @ shift
    return rotations, transl

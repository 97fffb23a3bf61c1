"""A grown map made anew from its poses, and with parts of it where other partial models put them.

Growing decides early what is a point and what a stray, and bends where little was seen. Adjusted once more
from its poses alone, with every sighting believed again, the map forgets that. Where it crossed few sightings
it may still be bent; a partial model of the frames beyond, made without crossing them, is then the better
start.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bigs.geometry.rotations import robust_mean_rotation
from bigs.preprocess.object_map import ObjectMap
from bigs.preprocess.sfm_models import PartialModel
from bigs.preprocess.sfm_seed import smooth_run
from bigs.preprocess.tracks import Tracks


@dataclass(frozen=True)
class RefineConfig:
    """How often, and what else is tried."""

    passes: int = 2
    # Rounds of bundle adjustment of everything in each pass.
    rounds: int = 2
    # A partial model whose turns differ from the map's by more than this is tried in its place, degrees, ...
    disagreement: float = 3.0
    # ... joined to the map at its frame nearest to the start, and that many frames deeper.
    depths: tuple[int, ...] = (0, 3)


def refine(
    map_: ObjectMap,
    tracks: Tracks,
    models: Sequence[PartialModel],
    start: np.ndarray,
    config: RefineConfig,
) -> tuple[ObjectMap, float]:
    """The map adjusted anew, from its own poses or from those with a partial model spliced in.

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
        for model, rotations, transl in splices(map_, models, start, config):
            anew = _made_anew(map_, tracks, rotations, transl)
            # A model that turns otherwise even from where the map takes it up was wrong itself, and what
            # came of it is no better than chance.
            agrees = disagreement(anew.rotations, model)[1].max(initial=0.0) <= config.disagreement
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


def disagreement(rotations: np.ndarray, model: PartialModel) -> tuple[np.ndarray, np.ndarray]:
    """By how much a partial model's frames are turned against the poses [T, 3, 3].

    Only its longest smooth run counts, and a model of few points not at all: such are often wrong themselves.

    Returns:
        Rows [n] of the model, and degrees [n] after the one turn of its frame that suits most of them.
    """
    rows = smooth_run(model.frames, model.rotations)
    if len(rows) < _FEWEST_FRAMES or len(model.points) < _FEWEST_POINTS:
        return np.zeros(0, dtype=int), np.zeros(0)
    between = model.rotations[rows].transpose(0, 2, 1) @ rotations[model.frames[rows]]
    usual = robust_mean_rotation(torch.from_numpy(between)).numpy()
    return rows, np.degrees(Rotation.from_matrix(between @ usual.T).magnitude())


_FEWEST_FRAMES = 5
_FEWEST_POINTS = 30


def _made_anew(map_: ObjectMap, tracks: Tracks, rotations: np.ndarray, transl: np.ndarray) -> ObjectMap:
    anew = ObjectMap(map_.features, tracks, map_.K, map_.config)
    anew.restart(np.arange(len(rotations)), rotations, transl)
    anew.settle()
    return anew


class Splice(NamedTuple):
    """Poses of all frames, with those of a partial model in place of the map's."""

    model: PartialModel
    rotations: np.ndarray  # [T, 3, 3]
    transl: np.ndarray  # [T, 3]


def splices(
    map_: ObjectMap, models: Sequence[PartialModel], start: np.ndarray, config: RefineConfig
) -> Iterable[Splice]:
    """What comes of putting each model that disagrees with the map in its place.

    Arguments as for `refine`; nothing where all models agree.
    """
    for model in models:
        rows, degrees = disagreement(map_.rotations, model)
        if degrees.max(initial=0.0) <= config.disagreement or np.isin(model.frames, start).any():
            continue
        # From the frame nearest to the start outwards.
        away = np.abs(model.frames[rows][:, None] - start).min(1)
        order = rows[np.argsort(away, kind="stable")]
        for depth in config.depths:
            if depth < len(order):
                yield Splice(model, *joined(map_, model, order[depth:]))


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

"""Similarity alignment of two shapes, for scores that ask about shape alone (CD_o, F5 and F10)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from bigs.checks import check_shape
from bigs.fused.nearest import NearestPoints
from bigs.metrics.shape import MAX_POINTS, Chamfer, ShapeScore, chamfer, draw, shape_score

# As many surface samples as in the published evaluator's alignment.
_COARSE_POINTS = 1000
_COARSE_ITERATIONS = 40
# The best starts are refined on (nearly) all vertices.
_FINE_STARTS = 10
_FINE_POINTS = 20_000
_FINE_ITERATIONS = 100
# Shapes are scaled to unit radius first, so this is a relative mean squared error.
_TOLERANCE = 1e-7
# Two starts that have come this near to each other, root mean square at unit radius, would end at the same
# place. So many samples tell.
_SAME = 0.02
_TELLING = 50

_UNSCORED = ShapeScore(Chamfer(np.inf, np.inf), 0.0, 0.0)


class Alignment(NamedTuple):
    """`target ~ scale * rotation @ source + translation`, and how well it fits."""

    scale: float
    rotation: np.ndarray  # [3, 3]
    translation: np.ndarray  # [3] metres
    score: ShapeScore  # of all vertices after the alignment

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Points [..., 3] of the source, moved onto the target."""
        return self.scale * points @ self.rotation.T + self.translation


def similarity_icp(
    source: np.ndarray,
    target: np.ndarray,
    source_faces: np.ndarray | None = None,
    target_faces: np.ndarray | None = None,
    seed: int = 0,
) -> Alignment:
    """The similarity (7 degrees of freedom) that brings `source` nearest to `target`.

    The published evaluator tries 600 random feature matches and keeps the smallest squared Chamfer distance.
    Here the starts are the 60 rotations of the icosahedral group about the centres (no rotation is further
    than 45 degrees from one of them); ICP runs from each on surface samples, the best few that came to
    different places are finished on the vertices, and the smallest squared Chamfer distance of the vertices
    wins. Nothing is random beyond the seeded samples, so the same input gives the same score.

    Args:
        source: vertices [N, 3], metres.
        target: vertices [M, 3], metres.
        source_faces: [F, 3]; without faces the samples are drawn from the vertices.
        target_faces: [G, 3], likewise.
        seed: of the samples.

    Returns:
        The alignment with its score over all vertices, at most `bigs.metrics.shape.MAX_POINTS` of each shape.
        A shape without extent is only moved.

    Raises:
        InputError: another shape.
    """
    for name, verts, faces in (("source", source, source_faces), ("target", target, target_faces)):
        check_shape(name, verts, ("N", 3))
        if faces is not None:
            check_shape(f"{name}_faces", faces, ("F", 3))
    generator = torch.Generator().manual_seed(seed)
    source_samples = _sample(source, source_faces, generator, seed)
    target_samples = _sample(target, target_faces, generator, seed)
    source_centre, target_centre = source_samples.mean(axis=0), target_samples.mean(axis=0)
    source_radius, target_radius = (
        np.sqrt(np.mean(np.sum((samples - centre) ** 2, axis=-1)))
        for samples, centre in ((source_samples, source_centre), (target_samples, target_centre))
    )
    source_scored = draw(source.astype(np.float64), MAX_POINTS, generator)
    target_scored = draw(target.astype(np.float64), MAX_POINTS, generator)
    if source_radius == 0.0 or target_radius == 0.0:
        moved = Alignment(1.0, np.eye(3), target_centre - source_centre, _UNSCORED)
        return moved._replace(score=shape_score(moved.apply(source_scored), target_scored))

    def to_metres(unit: np.ndarray) -> Alignment:
        """The alignment in metres of a similarity [4, 4] between the two shapes at unit radius about 0."""
        unit_scale = np.cbrt(np.linalg.det(unit[:3, :3]))
        scale, rotation = unit_scale * target_radius / source_radius, unit[:3, :3] / unit_scale
        translation = target_centre + target_radius * unit[:3, 3] - scale * rotation @ source_centre
        alignment = Alignment(float(scale), rotation, translation, _UNSCORED)
        return alignment._replace(score=shape_score(alignment.apply(source_scored), target_scored))

    coarse_source = (source_samples - source_centre) / source_radius
    coarse_target = (target_samples - target_centre) / target_radius
    fine_source = (draw(source_scored, _FINE_POINTS, generator) - source_centre) / source_radius
    fine_target = (draw(target_scored, _FINE_POINTS, generator) - target_centre) / target_radius
    starts = np.tile(np.eye(4), (60, 1, 1))
    starts[:, :3, :3] = Rotation.create_group("I").as_matrix()
    coarse = _icp(coarse_source, coarse_target, starts, _COARSE_ITERATIONS)
    costs = [_squared_chamfer(coarse_source, coarse_target, unit) for unit in coarse]
    best = coarse[np.argsort(costs, kind="stable")[:_FINE_STARTS]]
    telling = coarse_source[:: max(1, len(coarse_source) // _TELLING)]
    best = best[_elsewhere(_placed(telling, best))]
    fine = _icp(fine_source, fine_target, best, _FINE_ITERATIONS)
    return min(map(to_metres, [*best, *fine]), key=lambda fit: fit.score.chamfer.squared)


def _sample(verts: np.ndarray, faces: np.ndarray | None, generator: torch.Generator, seed: int) -> np.ndarray:
    if faces is None or len(faces) == 0:
        return draw(verts.astype(np.float64), _COARSE_POINTS, generator)
    mesh = trimesh.Trimesh(verts, faces, process=False)
    samples, _ = trimesh.sample.sample_surface(mesh, _COARSE_POINTS, seed=seed)
    return np.asarray(samples, dtype=np.float64)


def _icp(source: np.ndarray, target: np.ndarray, starts: np.ndarray, iterations: int) -> np.ndarray:
    """The similarities [S, 4, 4] that ICP reaches from `starts` [S, 4, 4], side by side.

    A start rests once a round lowers its mean squared distance by less than `_TOLERANCE`.
    """
    tree = NearestPoints(target)
    found, costs = starts.copy(), np.full(len(starts), np.inf)
    # Those of the round before are mostly right.
    index = np.zeros((len(starts), len(source)), dtype=np.uint32)
    active = np.arange(len(starts))
    for _ in range(iterations):
        moved = _placed(source, found[active])
        index[active] = tree.of(moved, index[active])[1]
        nearest = target[index[active]]
        step = _procrustes(moved, nearest)
        found[active] = step @ found[active]
        moved = _placed(moved, step)
        cost = ((nearest - moved) ** 2).sum(-1).mean(-1)
        going = costs[active] - cost >= _TOLERANCE
        costs[active] = cost
        active = active[going]
        if len(active) == 0:
            break
    return found


def _placed(points: np.ndarray, similarities: np.ndarray) -> np.ndarray:
    """Points [N, 3] moved by each of `similarities` [S, 4, 4]: [S, N, 3]."""
    return points @ similarities[:, :3, :3].transpose(0, 2, 1) + similarities[:, None, :3, 3]


def _elsewhere(placed: np.ndarray) -> np.ndarray:
    """Which of S sets of points [S, N, 3] are not where one before them is: [S] bool."""
    apart = np.square(placed[:, None] - placed).sum(-1).mean(-1)
    return ~np.tril(apart < _SAME**2, -1).any(1)


def _procrustes(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Similarities [S, 4, 4] that lay each of `source` [S, N, 3] on `target` [S, N, 3], point by point.

    The scale brings one spread to the other, so that it does not shrink where the two agree badly.
    """
    source_centre, target_centre = source.mean(1, keepdims=True), target.mean(1, keepdims=True)
    source, target = source - source_centre, target - target_centre
    u, _, vt = np.linalg.svd(target.transpose(0, 2, 1) @ source)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    rotation = u @ vt
    scale = np.sqrt((target**2).sum((1, 2)) / (source**2).sum((1, 2)))
    found = np.tile(np.eye(4), (len(source), 1, 1))
    found[:, :3, :3] = scale[:, None, None] * rotation
    found[:, :3, 3] = target_centre[:, 0] - (found[:, :3, :3] @ source_centre.transpose(0, 2, 1))[..., 0]
    return found


def _squared_chamfer(source: np.ndarray, target: np.ndarray, similarity: np.ndarray) -> float:
    moved = source @ similarity[:3, :3].T + similarity[:3, 3]
    return chamfer(moved, target).squared

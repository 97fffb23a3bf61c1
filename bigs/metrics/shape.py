"""Shape scores of point sets: Chamfer distance and F-score, in the field's units (cm², cm, percent)."""

from __future__ import annotations

from concurrent.futures import Future
from typing import NamedTuple

import numpy as np
import torch

from bigs.checks import InputError, check_shape
from bigs.fused.nearest import NearestPoints
from bigs.threads import beside, thread_count

# The evaluators draw this many vertices of each set in every frame (vertices, not surface samples).
POINTS_PER_FRAME = 3000
# Whole vertex sets are scored after alignment; larger sets are thinned, which changes no score noticeably.
MAX_POINTS = 100_000
_CM = 100.0


class Chamfer(NamedTuple):
    """Both sums run over the two directions and are not halved."""

    squared: float  # mean d1² + mean d2², cm²
    root: float  # mean d1 + mean d2, cm


class ShapeScore(NamedTuple):
    """Everything that one pair of nearest-neighbour searches gives."""

    chamfer: Chamfer
    f5: float  # percent
    f10: float  # percent


def chamfer(p: np.ndarray, g: np.ndarray) -> Chamfer:
    """Chamfer distance of two point sets [N, 3] and [M, 3] in metres."""
    return _chamfer(*_nearest_cm(p, g))


def f_score(p: np.ndarray, g: np.ndarray, threshold_mm: float) -> float:
    """F-score in percent of two point sets [N, 3] and [M, 3] in metres.

    It is the harmonic mean of the share of `p` with a neighbour in `g` nearer than the threshold, and of the
    share of `g` with one in `p`.
    """
    return _f_score(*_nearest_cm(p, g), threshold_mm)


def shape_score(p: np.ndarray, g: np.ndarray) -> ShapeScore:
    """Chamfer distance and F-scores at 5 and 10 mm of two point sets [N, 3] and [M, 3] in metres."""
    p_to_g, g_to_p = _nearest_cm(p, g)
    return ShapeScore(_chamfer(p_to_g, g_to_p), _f_score(p_to_g, g_to_p, 5.0), _f_score(p_to_g, g_to_p, 10.0))


def relative_scores(
    pred_object: np.ndarray,
    pred_origin: np.ndarray,
    gt_object: np.ndarray,
    gt_origin: np.ndarray,
    seed: int = 1,
) -> list[ShapeScore | None]:
    """Shape scores of every frame, the object of each side seen from that side's own origin.

    With the wrists as origins these are CD_r and CD_l of the paper. Sets above `POINTS_PER_FRAME` are
    replaced by that many random vertices, drawn anew in every frame from one generator, prediction first, as
    the evaluators do.

    Args:
        pred_object: vertices [T, V, 3], metres.
        pred_origin: [T, 3] metres.
        gt_object: vertices [T, W, 3], metres.
        gt_origin: [T, 3] metres.
        seed: of the draws.

    Returns:
        One score per frame; None where either side is not finite.
    """
    generator = torch.Generator().manual_seed(seed)
    waiting: list[Future[ShapeScore] | None] = []
    # Draws depend on each other, scores do not, and searching for neighbours needs no interpreter.
    with beside(thread_count()) as pool:
        for t in range(len(gt_object)):
            p, g = pred_object[t] - pred_origin[t], gt_object[t] - gt_origin[t]
            finite = np.isfinite(p).all() and np.isfinite(g).all()
            p, g = draw(p, POINTS_PER_FRAME, generator), draw(g, POINTS_PER_FRAME, generator)
            waiting.append(pool.submit(shape_score, p, g) if finite else None)
        return [None if score is None else score.result() for score in waiting]


def relative_chamfer(
    pred_object: np.ndarray,
    pred_wrist: np.ndarray,
    gt_object: np.ndarray,
    gt_wrist: np.ndarray,
    seed: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """CD_r or CD_l of every frame: see `relative_scores` for the arguments.

    Returns:
        [T] cm² (squared form) and [T] cm (root form); NaN where either side is not finite.
    """
    scores = relative_scores(pred_object, pred_wrist, gt_object, gt_wrist, seed)
    pairs = np.array([(np.nan, np.nan) if score is None else score.chamfer for score in scores])
    return pairs[:, 0], pairs[:, 1]


def draw(points: np.ndarray, count: int, generator: torch.Generator) -> np.ndarray:
    """At most `count` random rows of `points` [N, 3]; all of them, in order, when there are no more."""
    if len(points) <= count:
        return points
    return points[torch.randperm(len(points), generator=generator)[:count].numpy()]


def _nearest_cm(p: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances in centimetres from each point of `p` to `g`, and from each point of `g` to `p`."""
    for name, points in (("predicted points", p), ("true points", g)):
        check_shape(name, points, ("N", 3))
        if len(points) == 0:
            raise InputError(f"{name}: expected at least one point, found none")
    p_to_g, _ = NearestPoints(g).of(p)
    g_to_p, _ = NearestPoints(p).of(g)
    return _CM * p_to_g, _CM * g_to_p


def _chamfer(p_to_g: np.ndarray, g_to_p: np.ndarray) -> Chamfer:
    squared = np.mean(p_to_g**2) + np.mean(g_to_p**2)
    return Chamfer(float(squared), float(np.mean(p_to_g) + np.mean(g_to_p)))


def _f_score(p_to_g: np.ndarray, g_to_p: np.ndarray, threshold_mm: float) -> float:
    threshold_cm = threshold_mm / 10.0
    precision, recall = np.mean(p_to_g < threshold_cm), np.mean(g_to_p < threshold_cm)
    # the small term is the evaluators': without any match the score is 0
    return float(100.0 * 2.0 * precision * recall / (precision + recall + 1e-7))

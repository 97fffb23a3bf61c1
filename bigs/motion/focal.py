"""The focal length that tracks of a turning object tell, weighed against the one that was given.

A longer focal length and a greater depth change a picture only by its perspective: near parts of an object
grow less. Over the frames of a clip that is enough to tell the focal length to a few per cent. One from a
calibration is better than that, and one that somebody guessed is often worse. Both may have been given.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

from bigs.motion.bundle import Bundle, BundleConfig, cost_of, linearise_all, make_problem, scene_of
from bigs.motion.schur import Border, Observations, System, carried, focal_border, point_steps, reduce


@dataclass(frozen=True)
class FocalConfig:
    """What is believed of a given focal length, and how it is measured. Errors are shares of its length."""

    # Chance that the given one was calibrated, the usual error then, and that of a guess. With a chance of 1
    # nothing is measured.
    calibrated: float = 0.8
    calibrated_sigma: float = 0.005
    guessed_sigma: float = 0.08
    iterations: int = 20
    # Stop if a step lowers the cost by less than this share: a focal length changes it little.
    tolerance: float = 1e-5
    # More observations than this add time and no certainty, and fewer do not tell a focal length.
    most_observations: int = 40_000
    least_observations: int = 1000
    # Pixels beyond which an observation loses weight: less than for poses, since the best tracks know the
    # focal length best.
    pixel_sigma: float = 0.15
    # What lasts of an error along a track, as where reflections lag behind, is shared by whole parts of the
    # object, too: it counts so many times as much as if each sighting erred for itself.
    shared: float = 11.0
    # No measurement is better than this.
    least_sigma: float = 0.01


class FocalLength(NamedTuple):
    """Both as shares of the given focal length."""

    factor: float  # on the given focal length
    sigma: float  # standard deviation of the factor


def believed_focal(bundle: Bundle, K: np.ndarray, scales: BundleConfig, config: FocalConfig) -> FocalLength:
    """The focal length after tracks were heard.

    The given one counts as calibrated or guessed, each as likely as it makes what was measured.

    Args:
        bundle: poses, points and observations, adjusted with the given focal length.
        K: [3, 3] given intrinsics.
        scales: the motion prior.
        config: see there.
    """
    calibrated, guessed = config.calibrated_sigma, config.guessed_sigma
    if config.calibrated >= 1.0 or len(bundle.frame) < max(config.least_observations, 1):
        return FocalLength(1.0, calibrated)
    measured = measured_focal(bundle, K, scales, config)
    if not np.isfinite(measured.sigma):
        return FocalLength(1.0, calibrated)
    growth, variance = np.log(measured.factor), measured.sigma**2
    means, variances, likely = [], [], []
    for sigma, chance in ((calibrated, config.calibrated), (guessed, 1.0 - config.calibrated)):
        total = sigma**2 + variance
        means.append(sigma**2 / total * growth)
        variances.append(sigma**2 * variance / total)
        likely.append(np.log(max(chance, 1e-12)) - 0.5 * growth**2 / total - 0.5 * np.log(total))
    share = np.exp(np.array(likely) - max(likely))
    share /= share.sum()
    mean = float(share @ means)
    spread = float(share @ (np.array(variances) + (np.array(means) - mean) ** 2))
    return FocalLength(float(np.exp(mean)), float(np.sqrt(spread)))


def measured_focal(bundle: Bundle, K: np.ndarray, scales: BundleConfig, config: FocalConfig) -> FocalLength:
    """What tracks alone say, by bundle adjustment with the focal length among the unknowns.

    `sigma` is infinite where they say nothing.
    """
    bundle = _thinned(bundle, config.most_observations)
    scales = replace(scales, pixel_sigma=config.pixel_sigma)
    free = np.ones(len(bundle.rotations), dtype=bool)
    problem = make_problem(bundle, K, scales, free, None)
    growth, damping, sigma = 0.0, 1e-3, np.inf
    cost = cost_of(problem, bundle)
    for _ in range(config.iterations):
        system = linearise_all(problem, bundle)
        border = focal_border(problem.seen, scene_of(problem, bundle))
        for _ in range(6):
            step = _step(system, problem.seen, border, damping)
            if not step.stiffness > 0.0:
                return FocalLength(float(np.exp(growth)), np.inf)
            candidate = bundle._replace(
                rotations=Rotation.from_rotvec(step.poses[:, :3]).as_matrix() @ bundle.rotations,
                transl=bundle.transl + step.poses[:, 3:],
                points=_moved(bundle.points, problem.seen, step.points),
            )
            nearer = problem._replace(K=scaled_focal(K, np.exp(growth + step.growth)))
            new_cost = cost_of(nearer, candidate)
            if new_cost < cost:
                break
            damping *= 8.0
        else:
            break
        sigma = 1.0 / np.sqrt(step.stiffness)
        gain, cost, bundle, problem = cost - new_cost, new_cost, candidate, nearer
        growth, damping = growth + step.growth, max(damping / 6.0, 1e-6)
        if gain < config.tolerance * cost:
            break
    shared = config.shared * lasting_error(bundle, problem.K) / config.pixel_sigma
    return FocalLength(
        float(np.exp(growth)), float(np.hypot(sigma * np.hypot(1.0, shared), config.least_sigma))
    )


def lasting_error(bundle: Bundle, K: np.ndarray) -> float:
    """The standard deviation in pixels of that part of observations' errors that lasts along their tracks.

    Compared are errors two sightings apart, since a feature that is followed brings its error along to the
    next frame. Medians in place of squares leave outliers out. 0 where nothing lasts.
    """
    order = np.lexsort((bundle.frame, bundle.point))
    errors, point = bundle.residuals(K)[order], bundle.point[order]
    together = point[_APART:] == point[:-_APART]
    before, after = errors[:-_APART][together], errors[_APART:][together]
    if len(before) == 0:
        return 0.0
    # The variance of a sum less that of a difference is four times the covariance.
    sums, differences = (np.median(np.abs(v)) for v in (before + after, before - after))
    return float(_OF_MEDIAN / 2.0 * np.sqrt(max(sums**2 - differences**2, 0.0)))


# Sightings between which errors are compared.
_APART = 2
# A normal deviate's standard deviation in those of the median of its size.
_OF_MEDIAN = 1.4826


def scaled_focal(K: np.ndarray, factor: float) -> np.ndarray:
    """Intrinsics [3, 3] with both focal lengths times `factor`."""
    changed = K.copy()
    changed[[0, 1], [0, 1]] *= factor
    return changed


class _Step(NamedTuple):
    poses: np.ndarray  # [T, 6]
    points: np.ndarray  # [P, 3] by rank
    growth: float  # of the focal length's logarithm
    stiffness: float  # second derivative of the cost by it, everything else following


def _step(system: System, seen: Observations, border: Border, damping: float) -> _Step:
    """A damped step of everything: points eliminated first, then poses, then the focal length."""
    reduced = reduce(system, seen, damping)
    held = np.einsum("nij,nj->ni", reduced.inverses, border.points)
    stiffness = border.stiffness - float((held * border.points).sum())
    gradient = border.gradient - float((held * system.point_gradient).sum())
    column = border.poses - carried(system, seen, held)
    poses, follows = scipy.linalg.solve(
        reduced.matrix, np.stack([-reduced.gradient, -column], axis=1), assume_a="sym"
    ).T
    stiffness += float(column @ follows)
    growth = -(gradient + float(column @ poses)) / stiffness if stiffness > 0.0 else 0.0
    change = (poses + growth * follows).reshape(-1, 6)
    pulled = system._replace(point_gradient=system.point_gradient + growth * border.points)
    return _Step(change, point_steps(pulled, reduced, seen, change), growth, stiffness)


def _thinned(bundle: Bundle, most: int) -> Bundle:
    """Points at random, with all their observations, of which about `most` remain."""
    seen = np.bincount(bundle.point, minlength=len(bundle.points))
    order = np.random.default_rng(0).permutation(len(seen))
    kept = np.zeros(len(seen), dtype=bool)
    kept[order[np.cumsum(seen[order]) <= most]] = True
    rows = kept[bundle.point]
    used, point = np.unique(bundle.point[rows], return_inverse=True)
    return bundle._replace(
        points=bundle.points[used],
        frame=bundle.frame[rows],
        point=point,
        pixels=bundle.pixels[rows],
        precision=bundle.precision[rows],
    )


def _moved(points: np.ndarray, seen: Observations, steps: np.ndarray) -> np.ndarray:
    moved = points.copy()
    moved[seen.points] += steps
    return moved

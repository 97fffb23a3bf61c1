"""The focal length among the unknowns: against dense equations, and exact and noisy scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from turning_object import K, turning_object

from bigs.motion.bundle import Bundle, BundleConfig, adjust, alike
from bigs.motion.focal import (
    FocalConfig,
    FocalLength,
    believed_focal,
    lasting_error,
    measured_focal,
    scaled_focal,
)

SCALES = BundleConfig(pixel_sigma=0.15, iterations=60, tolerance=1e-9)
# Errors of tracks as they are told apart, without what is added for those of real ones.
BARE = FocalConfig(shared=0.0, least_sigma=0.0, least_observations=100, pixel_sigma=0.15)


def seen_through(factor: float, noise: float, frames: int = 30, seed: int = 0) -> Bundle:
    """A turning egg, adjusted with a focal length that is `factor` times the true one."""
    egg = turning_object(frames=frames, points=250, noise=noise, seed=seed)
    frame = np.concatenate([np.full(len(ids), t) for t, ids in enumerate(egg.ids)])
    point = np.concatenate(egg.ids)
    often = np.bincount(point, minlength=len(egg.points))[point] >= 4
    used, point = np.unique(point[often], return_inverse=True)
    pixels = np.concatenate([features.pixels for features in egg.features])[often]
    further = egg.transl * [1.0, 1.0, factor]
    start = Bundle(egg.rotations, further, egg.points[used], frame[often], point, pixels, alike(len(pixels)))
    return adjust(start, scaled_focal(K, factor), replace(SCALES, iterations=8))


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.06])
def test_exact_tracks_tell_the_focal_length(factor: float) -> None:
    found = measured_focal(seen_through(factor, 0.0), scaled_focal(K, factor), SCALES, BARE)
    assert found.factor * factor == pytest.approx(1.0, abs=2e-3)
    assert found.sigma < 0.02


def test_the_error_told_is_the_error_made() -> None:
    off, told = [], []
    for seed in range(6):
        found = measured_focal(seen_through(1.0, 0.15, seed=seed), K, SCALES, BARE)
        off.append(np.log(found.factor))
        told.append(found.sigma)
    usual = float(np.sqrt(np.mean(np.square(off))))
    assert 0.3 * np.mean(told) < usual < 2.0 * np.mean(told)


def drifting(share: float, seed: int = 0) -> Bundle:
    """The egg with errors of 0.3 pixels, whose variance is to this share the same along half a track."""
    bundle = seen_through(1.0, 0.0)
    rng = np.random.default_rng(seed)
    own = rng.normal(0.0, 0.3, bundle.pixels.shape)
    of_half = rng.normal(0.0, 0.3, (len(bundle.points), 2, 2))
    middle = np.bincount(bundle.point, bundle.frame)[bundle.point] / np.bincount(bundle.point)[bundle.point]
    lasts = of_half[bundle.point, (bundle.frame > middle).astype(int)]
    errors = np.sqrt(1.0 - share) * own + np.sqrt(share) * lasts
    rows = rng.permutation(len(errors))
    return bundle._replace(
        pixels=(bundle.pixels + errors)[rows], frame=bundle.frame[rows], point=bundle.point[rows]
    )


def test_an_error_that_lasts_is_told_from_noise() -> None:
    assert lasting_error(drifting(0.0), K) < 0.06
    # Halves of a track err in two ways, so that a few of its pairs share nothing.
    assert lasting_error(drifting(1.0), K) == pytest.approx(0.3, rel=0.2)
    assert lasting_error(drifting(0.5), K) == pytest.approx(0.3 * np.sqrt(0.5), rel=0.2)
    alone = drifting(1.0)
    first = np.unique(alone.point, return_index=True)[1]
    alone = alone._replace(frame=alone.frame[first], point=alone.point[first], pixels=alone.pixels[first])
    assert lasting_error(alone, K) == 0.0


def test_errors_that_last_make_the_focal_length_less_certain() -> None:
    config = replace(BARE, shared=FocalConfig().shared)
    noisy, lagging = (measured_focal(drifting(share), K, SCALES, config).sigma for share in (0.0, 0.8))
    assert lagging > 2.0 * noisy
    assert measured_focal(drifting(0.8), K, SCALES, BARE).sigma < lagging


def test_settings_of_the_focal_length_are_its_own() -> None:
    bundle = drifting(0.2)
    usual = measured_focal(bundle, K, SCALES, BARE)
    assert measured_focal(bundle, K, replace(SCALES, pixel_sigma=9.0), BARE) == usual
    assert measured_focal(bundle, K, SCALES, replace(BARE, pixel_sigma=0.05)).factor != usual.factor
    assert measured_focal(bundle, K, SCALES, replace(BARE, least_sigma=0.05)).sigma >= 0.05 > usual.sigma


def test_the_step_is_that_of_the_dense_equations() -> None:
    """One step from a start that is off, against the normal equations of finite differences."""
    import bigs.motion.focal as focal

    whole = seen_through(1.0, 0.3, frames=6)
    roots = np.random.default_rng(1).normal(0.0, 0.4, (len(whole.frame), 2, 2)) + np.eye(2)
    bundle = focal._thinned(
        whole._replace(precision=(roots @ roots.transpose(0, 2, 1))[:, [0, 0, 1], [0, 1, 1]]), 150
    )
    root = np.linalg.cholesky(bundle.precision[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    assert 80 < len(bundle.frame) <= 150
    scales = replace(SCALES, pixel_sigma=0.5, turn_sigma=1e4, shift_sigma=1e3)  # no prior to speak of
    problem = focal.make_problem(bundle, K, scales, np.ones(6, dtype=bool), None)
    border = focal.focal_border(problem.seen, focal.scene_of(problem, bundle))
    step = focal._step(focal.linearise_all(problem, bundle), problem.seen, border, 1e-2)

    def whitened(there: Bundle, K: np.ndarray) -> np.ndarray:
        return np.einsum("mji,mj->mi", root, there.residuals(K))

    residual = whitened(bundle, K)
    weight = np.sqrt(1.0 / (0.5**2 + (residual**2).sum(1)))[:, None]
    poses, count = 6 * 6, 6 * 6 + bundle.points.size + 1

    def moved(change: np.ndarray) -> np.ndarray:
        turned = focal.Rotation.from_rotvec(change[:poses].reshape(6, 6)[:, :3]).as_matrix()
        there = bundle._replace(
            rotations=turned @ bundle.rotations,
            transl=bundle.transl + change[:poses].reshape(6, 6)[:, 3:],
            points=bundle.points + change[poses:-1].reshape(-1, 3),
        )
        return (whitened(there, scaled_focal(K, np.exp(change[-1]))) * weight).ravel()

    jacobian = np.stack([(moved(d) - moved(-d)) / 2e-6 for d in 1e-6 * np.eye(count)], axis=1)
    matrix, gradient = jacobian.T @ jacobian, jacobian.T @ (residual * weight).ravel()
    matrix[np.diag_indices(count - 1)] *= 1.0 + 1e-2  # the focal length itself is not damped
    change = np.linalg.solve(matrix, -gradient)
    assert step.growth == pytest.approx(change[-1], rel=1e-3)
    np.testing.assert_allclose(step.poses.ravel(), change[:poses], atol=1e-3 * np.abs(change).max())
    places = np.empty_like(bundle.points)
    places[problem.seen.points] = step.points
    np.testing.assert_allclose(places.ravel(), change[poses:-1], atol=1e-3 * np.abs(change).max())
    assert step.stiffness == pytest.approx(1.0 / np.linalg.inv(matrix)[-1, -1], rel=1e-3)


def believed(measured: FocalLength, config: FocalConfig, monkeypatch: pytest.MonkeyPatch) -> FocalLength:
    monkeypatch.setattr("bigs.motion.focal.measured_focal", lambda *_: measured)
    many = np.zeros(2000, dtype=int)
    observed = (many, many, np.zeros((2000, 2)), alike(2000))
    bundle = Bundle(np.eye(3)[None], np.ones((1, 3)), np.zeros((1, 3)), *observed)
    return believed_focal(bundle, K, SCALES, config)


def test_a_small_contradiction_is_an_error_of_tracks_and_a_large_one_a_guess(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = FocalConfig()
    factors = [
        believed(FocalLength(np.exp(-off), 0.025), config, monkeypatch).factor
        for off in (0.0, 0.01, 0.03, 0.06, 0.1, 0.2)
    ]
    assert factors[0] == pytest.approx(1.0)
    assert factors[1] > 0.998
    assert factors[3] < 0.98
    assert factors[4:] == pytest.approx(np.exp([-0.1, -0.2]), rel=0.02)
    assert all(np.diff(factors) < 0)
    # Who errs in doubt says so.
    doubtful = believed(FocalLength(0.95, 0.025), config, monkeypatch)
    assert doubtful.sigma > 2 * believed(FocalLength(1.0, 0.025), config, monkeypatch).sigma


def test_a_calibrated_camera_and_too_few_tracks_keep_what_was_given(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = FocalLength(0.8, 0.01)
    assert believed(wrong, FocalConfig(calibrated=1.0), monkeypatch).factor == 1.0
    assert believed(wrong, FocalConfig(least_observations=3000), monkeypatch).factor == 1.0
    assert believed(FocalLength(0.8, np.inf), FocalConfig(), monkeypatch).factor == 1.0
    none = np.zeros(0, dtype=int)
    observed = (none, none, np.zeros((0, 2)), alike(0))
    nothing = Bundle(np.eye(3)[None], np.ones((1, 3)), np.zeros((0, 3)), *observed)
    assert believed_focal(nothing, K, SCALES, FocalConfig(least_observations=0)).factor == 1.0
    assert believed(wrong, FocalConfig(calibrated=0.0), monkeypatch).factor == pytest.approx(0.8, rel=0.01)

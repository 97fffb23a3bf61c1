"""Bundle adjustment against exact scenes, and its prior against frames that show nothing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from turning_object import K, TurningObject, rotation_errors, turning_object

from bigs.motion.bundle import Bundle, BundleConfig, adjust, alike, turn_uncertainties


@pytest.fixture(scope="module")
def egg() -> TurningObject:
    return turning_object(frames=16, points=200, noise=0.0)


def true_bundle(egg: TurningObject) -> Bundle:
    frame = np.concatenate([np.full(len(ids), t) for t, ids in enumerate(egg.ids)])
    pixels = np.concatenate([features.pixels for features in egg.features])
    point = np.concatenate(egg.ids)
    return Bundle(egg.rotations, egg.transl, egg.points, frame, point, pixels, alike(len(pixels)))


def disturbed(bundle: Bundle, rng: np.random.Generator, frames: slice = slice(None)) -> Bundle:
    rotations, transl = bundle.rotations.copy(), bundle.transl.copy()
    count = len(rotations[frames])
    rotations[frames] = (
        Rotation.from_rotvec(np.radians(3.0) * rng.standard_normal((count, 3))).as_matrix()
        @ rotations[frames]
    )
    transl[frames] += 0.005 * rng.standard_normal((count, 3))
    points = bundle.points + 0.003 * rng.standard_normal(bundle.points.shape)
    return bundle._replace(rotations=rotations, transl=transl, points=points)


def test_exact_observations_are_met_from_a_disturbed_start(egg: TurningObject) -> None:
    # With the prior all but off, the exact scene costs nothing.
    config = BundleConfig(turn_sigma=50.0, shift_sigma=1.0, iterations=60, tolerance=1e-9)
    found = adjust(disturbed(true_bundle(egg), np.random.default_rng(1)), K, config)
    seen = np.bincount(found.point, minlength=len(found.points))[found.point] >= 2
    assert np.abs(found.residuals(K)[seen]).max() < 0.02
    assert rotation_errors(found.rotations, egg.rotations).max() < 0.1


def test_wrong_observations_hardly_move_the_poses(egg: TurningObject) -> None:
    rng = np.random.default_rng(2)
    bundle = true_bundle(egg)
    wrong = rng.random(len(bundle.pixels)) < 0.1
    pixels = bundle.pixels + wrong[:, None] * rng.uniform(-30, 30, bundle.pixels.shape)
    found = adjust(bundle._replace(pixels=pixels), K, BundleConfig())
    assert rotation_errors(found.rotations, egg.rotations).max() < 0.2


def test_what_an_observation_says_vaguely_hardly_moves_the_poses(egg: TurningObject) -> None:
    """As a patch on an edge says: across the edge it is right, along it by three pixels wrong."""
    rng = np.random.default_rng(5)
    bundle = true_bundle(egg)
    angle = rng.uniform(0.0, np.pi, len(bundle.pixels))
    edge = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    pixels = bundle.pixels + rng.normal(0.0, 3.0, (len(edge), 1)) * edge
    across = np.stack([edge[:, 1] ** 2, -edge[:, 0] * edge[:, 1], edge[:, 0] ** 2], axis=1)
    vague = bundle._replace(pixels=pixels, precision=across + 1e-4 * alike(len(edge)))
    known = rotation_errors(adjust(vague, K, BundleConfig()).rotations, egg.rotations)
    blind = vague._replace(precision=bundle.precision)
    ignored = rotation_errors(adjust(blind, K, BundleConfig()).rotations, egg.rotations)
    assert known.max() < 0.1 < 0.5 * ignored.max()


def test_a_frame_without_observations_goes_where_the_motion_leads(egg: TurningObject) -> None:
    bundle = true_bundle(egg)
    keep = ~np.isin(bundle.frame, (7, 8))
    blind = bundle._replace(
        frame=bundle.frame[keep],
        point=bundle.point[keep],
        pixels=bundle.pixels[keep],
        precision=bundle.precision[keep],
    )
    found = adjust(disturbed(blind, np.random.default_rng(3), slice(7, 9)), K, BundleConfig(iterations=40))
    assert rotation_errors(found.rotations, egg.rotations).max() < 0.5
    assert np.linalg.norm(found.transl - egg.transl, axis=1)[7:9].max() < 0.002


def test_only_free_frames_move(egg: TurningObject) -> None:
    free = np.zeros(16, dtype=bool)
    free[5] = True
    start = disturbed(true_bundle(egg), np.random.default_rng(4), slice(5, 6))
    found = adjust(start, K, BundleConfig(), free=free)
    assert np.array_equal(found.rotations[~free], start.rotations[~free])
    assert not np.allclose(found.rotations[5], start.rotations[5])
    assert rotation_errors(found.rotations, egg.rotations)[5] < 0.3


def test_uncertainty_grows_where_no_point_leads_across(egg: TurningObject) -> None:
    bundle = true_bundle(egg)
    config = BundleConfig(turn_sigma=3.0, shift_sigma=0.015)
    whole = turn_uncertainties(bundle, K, config)[3]
    # No point is the same one before and after frame 8.
    count = len(bundle.points)
    cut = bundle._replace(
        points=np.concatenate([bundle.points, bundle.points]),
        point=bundle.point + count * (bundle.frame >= 8),
    )
    parted = turn_uncertainties(cut, K, config)[3]
    assert whole[3] == pytest.approx(0.0, abs=1e-3)
    assert parted[8:].min() > 4 * whole[8:].max()
    assert parted[:8].max() < 4 * whole[:8].max()


def test_uncertainty_does_not_depend_on_the_object_frame(egg: TurningObject) -> None:
    bundle = true_bundle(egg)
    turn = Rotation.from_rotvec([0.5, 0.2, -0.9]).as_matrix()
    turned = bundle._replace(rotations=bundle.rotations @ turn.T, points=bundle.points @ turn.T)
    config = BundleConfig()
    np.testing.assert_allclose(
        turn_uncertainties(bundle, K, config),
        turn_uncertainties(turned, K, config),
        rtol=1e-3,
        atol=1e-3,
    )

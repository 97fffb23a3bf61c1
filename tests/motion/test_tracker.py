"""Motion from tracks where poses are known roughly: gross errors, plain objects, uncertainty."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from filmed_egg import film
from scipy.spatial.transform import Rotation
from turning_object import K, TurningObject, rotation_errors, turning_object

from bigs.motion.bundle import Anchor, Bundle, BundleConfig, adjust, alike, pose_covariances
from bigs.motion.features import NOTHING
from bigs.motion.given_poses import GivenPoses, contradicted_frames, pairs_to_match
from bigs.motion.tracker import sustained_departure, track_matches
from bigs.motion.tracker_config import TrackerConfig

FRAMES = 20
CONFIG = TrackerConfig()


class Filmed(NamedTuple):
    egg: TurningObject
    images: list[np.ndarray]
    masks: np.ndarray


@pytest.fixture(scope="module")
def filmed() -> Filmed:
    egg = turning_object(frames=FRAMES, points=300)
    return Filmed(egg, *film(egg))


def given_poses(egg: TurningObject, degrees: float = 1.5, wrong: tuple[int, ...] = ()) -> GivenPoses:
    """The true poses less `degrees` and 3 mm of noise; frames `wrong` are turned by 60 degrees besides."""
    rng = np.random.default_rng(5)
    count = len(egg.rotations)
    noise = Rotation.from_rotvec(np.radians(degrees) / np.sqrt(3.0) * rng.standard_normal((count, 3)))
    rotations = noise.as_matrix() @ egg.rotations
    for t in wrong:
        axis = rng.standard_normal(3)
        turn = Rotation.from_rotvec(np.radians(60.0) * axis / np.linalg.norm(axis))
        rotations[t] = turn.as_matrix() @ rotations[t]
    transl = egg.transl + 0.003 * rng.standard_normal((count, 3))
    return GivenPoses(rotations, transl, np.ones(count))


@pytest.mark.parametrize("wrong", [(), (6, 13), (9, 10)])
def test_tracks_correct_given_poses_even_gross_ones(filmed: Filmed, wrong: tuple[int, ...]) -> None:
    egg = filmed.egg
    given = given_poses(egg, wrong=wrong)
    found = track_matches(egg.features, egg.matches(overlap=6), filmed.images, filmed.masks, K, given, CONFIG)
    assert np.flatnonzero(found.contradicted).tolist() == list(wrong)
    assert rotation_errors(found.rotations, egg.rotations).max() < 0.4
    # The object frame and its size stay the given ones.
    between = Rotation.from_matrix(found.rotations.transpose(0, 2, 1) @ egg.rotations).mean()
    assert np.degrees(between.magnitude()) < 1.0
    assert found.transl[:, 2].mean() / egg.transl[:, 2].mean() == pytest.approx(1.0, abs=0.005)
    assert np.linalg.norm(found.transl - egg.transl, axis=1)[:, None].mean() < 0.004
    # They know of the given poses' errors, and of their own.
    assert np.degrees(found.turn_sigma) == pytest.approx(1.5 / np.sqrt(3.0), rel=0.5)
    sure = np.degrees(np.sqrt(np.einsum("tii->t", found.covariance[:, :3, :3])))
    assert sure.max() < 0.6
    assert len(found.points) > 100
    shell = np.linalg.norm(found.points @ between.as_matrix().T / (0.05, 0.09, 0.035), axis=1)
    assert np.median(np.abs(shell - 1.0)) < 0.05


def test_poses_worse_than_any_are_corrected_though_not_thought_so(filmed: Filmed) -> None:
    egg = filmed.egg
    given = given_poses(egg, degrees=8.0)
    found = track_matches(egg.features, egg.matches(overlap=6), filmed.images, filmed.masks, K, given, CONFIG)
    assert np.degrees(found.turn_sigma) == pytest.approx(CONFIG.most_turn_sigma)
    assert rotation_errors(given.rotations, egg.rotations).mean() > 5.0
    assert rotation_errors(found.rotations, egg.rotations).max() < 1.0


def test_an_object_without_texture_keeps_its_poses(filmed: Filmed) -> None:
    given = given_poses(filmed.egg)
    found = track_matches([NOTHING] * FRAMES, {}, filmed.images, filmed.masks, K, given, CONFIG)
    assert not found.contradicted.any() and not found.observations.any() and len(found.points) == 0
    # Smoothed a little, and as uncertain as anything that nobody measured.
    assert rotation_errors(found.rotations, given.rotations).max() < 5.0
    before = rotation_errors(given.rotations, filmed.egg.rotations).mean()
    assert rotation_errors(found.rotations, filmed.egg.rotations).mean() < before
    assert np.degrees(np.sqrt(np.einsum("tii->t", found.covariance[:, :3, :3]) / 3.0)).min() > 1.0


def test_frames_that_show_nothing_go_by_what_was_given(filmed: Filmed) -> None:
    egg = filmed.egg
    blind = range(8, 12)
    matches = {pair: rows for pair, rows in egg.matches(overlap=6).items() if not set(pair) & set(blind)}
    masks = filmed.masks.copy()
    masks[list(blind)] = False
    found = track_matches(egg.features, matches, filmed.images, masks, K, given_poses(egg), CONFIG)
    error = rotation_errors(found.rotations, egg.rotations)
    assert error[12:].max() < 0.6 and error[list(blind)].max() < 1.0
    sure = np.sqrt(np.einsum("tii->t", found.covariance[:, :3, :3]))
    assert sure[9:11].min() > max(sure[7], sure[12])


def test_pairs_are_neighbours_and_frames_that_look_alike() -> None:
    # To and fro: frame 19 shows what frame 0 shows.
    turns = np.radians(6.0) * np.concatenate([np.arange(10), np.arange(9, -1, -1)])
    rotations = Rotation.from_rotvec(turns[:, None] * [0.0, 1.0, 0.0]).as_matrix()
    given = GivenPoses(rotations, np.tile([0.0, 0.0, 0.7], (20, 1)), np.ones(20))
    pairs = set(pairs_to_match(given, CONFIG))
    assert {(0, 1), (0, 6), (13, 19), (0, 19), (1, 18)} <= pairs
    assert (0, 10) not in pairs  # 54 degrees apart


def test_poses_that_agree_with_their_matches_are_believed(filmed: Filmed) -> None:
    egg = filmed.egg
    assert not contradicted_frames(egg.features, egg.tracks(), K, given_poses(egg, 1.0), CONFIG).any()
    # A whole run of frames off by the same turn agrees with itself only.
    given = given_poses(egg, 0.5)
    turn = Rotation.from_rotvec([0.0, np.radians(60.0), 0.0]).as_matrix()
    given.rotations[15:] = given.rotations[15:] @ turn
    found = contradicted_frames(egg.features, egg.tracks(), K, given, CONFIG)
    assert np.flatnonzero(found).tolist() == [15, 16, 17, 18, 19]


@pytest.fixture(scope="module")
def little() -> Bundle:
    """Ten frames of a cube of 25 points, exact."""
    rng = np.random.default_rng(8)
    rotations = Rotation.from_rotvec(np.linspace(0, 0.9, 10)[:, None] * [0.2, 1.0, 0.1]).as_matrix()
    frame, point = (part.ravel() for part in np.mgrid[:10, :25])
    bundle = Bundle(
        rotations,
        np.tile([0.01, 0.0, 0.7], (10, 1)),
        rng.uniform(-0.05, 0.05, (25, 3)),
        frame,
        point,
        np.zeros((250, 2)),
        alike(250),
    )
    return bundle._replace(pixels=bundle.residuals(K))


def test_covariances_are_those_of_many_adjustments(little: Bundle) -> None:
    rng = np.random.default_rng(9)
    # Errors far below the losses' scales, where they are squares. Neither prior nor anchor say much.
    sigma = 0.05
    config = BundleConfig(pixel_sigma=0.5, turn_sigma=50.0, shift_sigma=0.1, tolerance=1e-10)
    anchor = Anchor(little.rotations, little.transl, np.ones(10), 0.05, np.full(3, 0.02))
    off = []
    for _ in range(60):
        pixels = little.pixels + sigma * rng.standard_normal(little.pixels.shape)
        found = adjust(little._replace(pixels=pixels), K, config, anchor=anchor)
        # Without what the object's frame as a whole has done.
        turns = Rotation.from_matrix(little.rotations.transpose(0, 2, 1) @ found.rotations)
        turns = turns * turns.mean().inv()
        off.append(np.einsum("tij,tj->ti", little.rotations, turns.as_rotvec()))
    scatter = np.sqrt(np.mean(np.square(off), axis=(0, 2)))
    covariance = pose_covariances(little, K, config, anchor)
    told = np.sqrt(np.einsum("tii->t", covariance[:, :3, :3]) / 3.0) * sigma / config.pixel_sigma
    np.testing.assert_allclose(told, scatter, rtol=0.35)
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_an_anchor_holds_what_no_observation_tells(little: Bundle) -> None:
    none = (little.frame[:0], little.point[:0], little.pixels[:0], little.precision[:0])
    nothing = Bundle(little.rotations, little.transl, little.points, *none)
    anchor = Anchor(little.rotations, little.transl, np.ones(10), np.radians(1.0), np.full(3, 0.002))
    rng = np.random.default_rng(3)
    turned = Rotation.from_rotvec(0.03 * rng.standard_normal((10, 3))).as_matrix() @ little.rotations
    start = nothing._replace(rotations=turned, transl=little.transl + 0.002)
    found = adjust(start, K, BundleConfig(iterations=60, tolerance=1e-12), anchor=anchor)
    assert rotation_errors(found.rotations, little.rotations).max() < 0.05
    np.testing.assert_allclose(found.transl, little.transl, atol=1e-4)
    # One that is grossly off pulls no more.
    wrong = anchor.rotations.copy()
    wrong[4] = Rotation.from_rotvec([0.0, 0.0, 1.0]).as_matrix() @ wrong[4]
    found = adjust(
        start, K, BundleConfig(iterations=60, tolerance=1e-12), anchor=anchor._replace(rotations=wrong)
    )
    assert rotation_errors(found.rotations, little.rotations).max() < 1.0


def test_only_what_lasts_is_a_sustained_departure() -> None:
    rng = np.random.default_rng(2)
    rotations = Rotation.from_rotvec(np.linspace(0, 3, 60)[:, None] * [0.0, 1.0, 0.1]).as_matrix()
    sigma = np.radians(1.0)
    noise = sigma * rng.standard_normal((60, 3))
    noise[::10] += 0.5
    anchor = Anchor(
        Rotation.from_rotvec(noise).as_matrix() @ rotations, np.zeros((60, 3)), np.ones(60), sigma, np.ones(3)
    )
    assert sustained_departure(rotations, anchor) < 2.0
    bent = rotations.copy()
    bent[46:] = Rotation.from_rotvec([0.0, 0.0, 4.0 * sigma]).as_matrix() @ bent[46:]
    assert sustained_departure(bent, anchor) == pytest.approx(4.0, abs=1.0)
    # Frames without a given pose depart from nothing.
    trust = np.where(np.arange(60) < 46, 1.0, 0.0)
    assert sustained_departure(bent, anchor._replace(trust=trust)) < 2.0

"""Points measured by their patches, on rendered pictures of a textured egg whose poses are exact."""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np
import pytest
from filmed_egg import WIDTH, film
from patch_twin import cut_twin, lay_twin
from scipy.spatial.transform import Rotation
from turning_object import K, TurningObject, rotation_errors, turning_object

from bigs.motion.object_map import MapConfig, ObjectMap
from bigs.motion.patches import PatchConfig, Pictures, cut_templates, lay, sharpen


class Filmed(NamedTuple):
    """An egg, its pictures, and the map that its features give at disturbed poses."""

    egg: TurningObject
    images: list[np.ndarray]
    masks: np.ndarray
    map: ObjectMap


@pytest.fixture(scope="module")
def filmed() -> Filmed:
    """24 frames; no track is longer than four, so that the map is a chain of short links."""
    egg = turning_object(frames=24, points=500, noise=0.3)
    whole = egg.tracks()
    _, piece = np.unique(whole.track * 24 + (whole.frame + whole.track) // 4, return_inverse=True)
    tracks = whole._replace(track=piece, total=int(piece.max()) + 1)
    map_ = ObjectMap(egg.features, tracks, K, MapConfig())
    # A bend as drift makes it: a turn that grows along the clip.
    bend = Rotation.from_rotvec(np.linspace(-1.5, 1.5, 24)[:, None] * [0.0, 1.0, 0.4], degrees=True)
    map_.restart(np.arange(24), egg.rotations @ bend.as_matrix(), egg.transl)
    map_.settle()
    return Filmed(egg, *film(egg), map_)


def test_poses_and_points_get_better(filmed: Filmed) -> None:
    egg, found = filmed.egg, copy.deepcopy(filmed.map)
    before = rotation_errors(found.rotations, egg.rotations)
    observations = found.use().sum()
    sharpen(found, Pictures(filmed.images, filmed.masks, PatchConfig()), PatchConfig())
    after = rotation_errors(found.rotations, egg.rotations)
    assert np.median(after) < 0.4 * np.median(before) and after.max() < before.max()
    assert found.use().sum() > 1.2 * observations


def test_every_observation_is_on_the_object_and_stands_for_one_point(filmed: Filmed) -> None:
    masks = filmed.masks.copy()
    masks[10:14, :, : WIDTH // 2] = False  # a hand over the left half
    found = copy.deepcopy(filmed.map)
    found.good[np.isin(found.frame, np.arange(10, 14)) & (found.pixels[:, 0] < WIDTH // 2)] = False
    sharpen(found, Pictures(filmed.images, masks, PatchConfig()), PatchConfig())
    use = found.use()
    column, row = found.pixels[use].astype(int).T
    assert masks[found.frame[use], row, column].mean() > 0.99
    pairs = np.stack([found.frame[use], found.track[use]])
    assert np.unique(pairs, axis=1).shape[1] == use.sum()
    # Points are seen again after the hand.
    before, after = (found.track[use & there] for there in (found.frame < 10, found.frame >= 14))
    assert len(np.intersect1d(before, after)) > 50


def test_pictures_of_something_else_leave_the_matches_in_force(filmed: Filmed) -> None:
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, image.shape, dtype=np.uint8) for image in filmed.images]
    found = copy.deepcopy(filmed.map)
    before, observations = found.rotations.copy(), found.use().sum()
    sharpen(found, Pictures(noise, filmed.masks, PatchConfig()), PatchConfig())
    assert found.use().sum() > 0.9 * observations
    assert rotation_errors(found.rotations, before).max() < 0.5


def test_patches_count_by_what_they_say_and_what_was_not_recognised_little(filmed: Filmed) -> None:
    """But a frame of noise, where nothing is recognised, goes by its matches."""
    config = PatchConfig()
    images = [*filmed.images]
    images[5] = np.random.default_rng(1).integers(0, 255, images[5].shape, dtype=np.uint8)
    found = copy.deepcopy(filmed.map)
    sharpen(found, Pictures(images, filmed.masks, config), config)
    use = found.use()
    sigma, vague = found.config.bundle.pixel_sigma, config.unrecognised_error
    matrices = found.precision[:, [0, 1, 1, 2]].reshape(-1, 2, 2) / sigma**2
    errors = 1.0 / np.sqrt(np.linalg.eigvalsh(matrices))  # pixels, the largest first
    np.testing.assert_allclose(errors[use & (found.frame == 5)], sigma, rtol=1e-6)
    elsewhere = errors[use & (found.frame != 5)]
    assert np.isclose(elsewhere[:, 1], vague).any()
    assert elsewhere.min() > 0.99 * config.least_error
    assert np.median(elsewhere[:, 0]) > 1.3 * np.median(elsewhere[:, 1])
    # What is told to be surer is nearer to where the true object has it.
    seen = use & (found.frame != 5) & ~np.isclose(errors[:, 1], vague)
    off = np.linalg.norm(found.reproject(seen) - found.pixels[seen], axis=1)
    told = errors[seen, 0]
    sure = told < np.median(told)
    assert np.median(off[sure]) < 0.8 * np.median(off[~sure])


def test_optimism_and_the_least_error_say_how_much_a_patch_is_believed(filmed: Filmed) -> None:
    def errors(**settings: float) -> np.ndarray:
        config = PatchConfig(passes=1, **settings)
        found = copy.deepcopy(filmed.map)
        sharpen(found, Pictures(filmed.images, filmed.masks, config), config)
        matrices = found.precision[:, [0, 1, 1, 2]].reshape(-1, 2, 2) / found.config.bundle.pixel_sigma**2
        errors = 1.0 / np.sqrt(np.linalg.eigvalsh(matrices))
        return errors[~np.isclose(errors[:, 1], config.unrecognised_error)]

    usual, doubled = errors(least_error=1e-4), errors(least_error=1e-4, optimism=4.0)
    assert np.median(doubled) == pytest.approx(2.0 * np.median(usual), rel=1e-3)
    assert errors(least_error=0.1).min() == pytest.approx(0.1)


@pytest.mark.parametrize("grey", [0, 128])
def test_even_pictures_leave_the_matches_in_force(filmed: Filmed, grey: int) -> None:
    even = [np.full_like(image, grey) for image in filmed.images]
    found = copy.deepcopy(filmed.map)
    before = found.rotations.copy()
    sharpen(found, Pictures(even, filmed.masks, PatchConfig()), PatchConfig())
    assert np.isfinite(found.rotations).all()
    assert rotation_errors(found.rotations, before).max() < 0.5


def test_large_pictures_are_shrunk_and_measured_in_their_own_pixels(filmed: Filmed) -> None:
    small = PatchConfig(max_side=150)
    pictures = Pictures(filmed.images, filmed.masks, small)
    assert pictures.shrunk > 1
    pixels = np.array([[250.3, 170.9], [201.0, 222.2]])
    assert np.allclose(pictures.pixels(3, pictures.places(3, pixels)), pixels, atol=1e-3)
    found = copy.deepcopy(filmed.map)
    before = rotation_errors(found.rotations, filmed.egg.rotations)
    sharpen(found, pictures, small)
    after = rotation_errors(found.rotations, filmed.egg.rotations)
    assert np.median(after) < 0.6 * np.median(before)


def test_frames_without_the_object_are_no_hindrance(filmed: Filmed) -> None:
    masks = filmed.masks.copy()
    masks[5] = False
    found = copy.deepcopy(filmed.map)
    found.good[found.frame == 5] = False
    sharpen(found, Pictures(filmed.images, masks, PatchConfig()), PatchConfig())
    assert not (found.use() & (found.frame == 5)).any()
    assert np.isfinite(found.transl).all()


@pytest.mark.parametrize(("coarser", "half", "turned"), [(1, 4, True), (1, 6, False), (2, 6, False)])
def test_the_engine_does_what_its_twin_does(filmed: Filmed, coarser: int, half: int, turned: bool) -> None:
    config = PatchConfig(half=half, most_unsure=0.4)
    pictures = Pictures(filmed.images, filmed.masks, config, coarser)
    rng = np.random.default_rng(half)
    pixels = rng.permutation(np.argwhere(filmed.masks[7])[:, ::-1])[:300] + rng.uniform(size=(300, 2))
    warp = np.tile(np.eye(2), (300, 1, 1)) + turned * rng.normal(0.0, 0.15, (300, 2, 2))
    start = pixels + rng.normal(0.0, 1.0, (300, 2))
    templates = cut_templates(pictures, np.full(300, 7), pixels, config)
    wanted = cut_twin(pictures, 7, pixels, config)
    for name, part, twin in zip(templates._fields, templates, wanted, strict=True):
        assert np.allclose(part, twin, atol=3e-3), name
    laid = lay(pictures, 8, start, warp, templates, config)
    twin, likeness = lay_twin(pictures, 8, start, warp, wanted, config)
    assert 50 < twin.fits.sum() < 300
    # Where rounding decides nothing, both decide alike.
    plain = np.abs(likeness - config.likeness) > 1e-3
    assert (laid.fits != twin.fits)[plain].sum() <= 2
    both = laid.fits & twin.fits
    assert np.abs(laid.pixels - twin.pixels)[both].max() < 5e-3 * coarser
    size = np.einsum("nii->n", twin.covariances)[:, None, None]
    assert (np.abs(laid.covariances - twin.covariances) / size)[both].max() < 0.03

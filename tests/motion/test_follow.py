"""Features followed from frame to frame, on rendered pictures of a textured egg whose motion is exact."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from filmed_egg import WIDTH, film
from turning_object import AXES, K, TurningObject, turning_object

from bigs.motion.follow import FollowConfig, Matches, follow

FRAMES = 8
CONFIG = FollowConfig()


class Filmed(NamedTuple):
    """An egg, its pictures, and the few matches that descriptors found."""

    egg: TurningObject
    images: list[np.ndarray]
    masks: np.ndarray
    few: Matches


@pytest.fixture(scope="module")
def filmed() -> Filmed:
    egg = turning_object(frames=FRAMES, points=400, noise=0.1)
    few = {pair: rows[:25] for pair, rows in egg.matches(overlap=2).items()}
    return Filmed(egg, *film(egg), few)


def carried(egg: TurningObject, t: int, pixels: np.ndarray) -> np.ndarray:
    """Where frame `t + 1` shows the egg's places at pixels [N, 2] of frame `t`; NaN beside the egg."""
    rotation, transl = egg.rotations[t], egg.transl[t]
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T
    eye, ray = -(rotation.T @ transl) / AXES, (rays @ rotation) / AXES
    a, b, c = (ray**2).sum(1), ray @ eye, eye @ eye - 1.0
    root = np.where(b**2 > a * c, b**2 - a * c, np.nan)
    place = (eye + ((-b - np.sqrt(root)) / a)[:, None] * ray) * AXES
    image = (place @ egg.rotations[t + 1].T + egg.transl[t + 1]) @ K.T
    return image[:, :2] / image[:, 2:]


def test_features_land_where_the_surface_goes(filmed: Filmed) -> None:
    egg = filmed.egg
    features, matches = follow(egg.features, filmed.few, filmed.images, filmed.masks, CONFIG)
    for t in range(FRAMES - 1):
        pairs = matches[t, t + 1]
        known = filmed.few[t, t + 1]
        assert np.array_equal(pairs[: len(known)], known)
        assert len(pairs) > 4 * len(known)
        # A feature stands for one place: it has one partner at most.
        assert all(len(np.unique(side)) == len(side) for side in pairs.T)
        new = pairs[len(known) :]
        begun, landed = features[t].pixels[new[:, 0]], features[t + 1].pixels[new[:, 1]]
        off = np.linalg.norm(landed - carried(egg, t, begun), axis=1)
        # Landing on a feature means to take its place, which is 0.1 pixels off in each direction.
        assert np.nanmedian(off) < 0.3 and np.nanpercentile(off, 95) < 1.2
    # What an earlier frame's features lead to is followed on.
    assert len(np.intersect1d(matches[0, 1][25:, 1], matches[1, 2][:, 0])) > 50


def test_features_that_were_there_keep_their_numbers(filmed: Filmed) -> None:
    features, matches = follow(filmed.egg.features, filmed.few, filmed.images, filmed.masks, CONFIG)
    for before, after in zip(filmed.egg.features, features, strict=True):
        for old, new in zip(before, after, strict=True):
            assert np.array_equal(new[: len(old)], old)
            assert len(new) == len(after.pixels)
    assert features[0] is filmed.egg.features[0]
    assert np.array_equal(matches[0, 2], filmed.few[0, 2])


def test_nothing_lands_on_a_hand(filmed: Filmed) -> None:
    masks = filmed.masks.copy()
    masks[4, :, : WIDTH // 2] = False
    features, matches = follow(filmed.egg.features, filmed.few, filmed.images, masks, CONFIG)
    landed = features[4].pixels[matches[3, 4][25:, 1]]
    # Landing near a feature means to take its place.
    assert len(landed) > 20 and landed[:, 0].min() >= WIDTH // 2 - CONFIG.same
    assert len(matches[3, 4]) < len(matches[2, 3])


@pytest.mark.parametrize("what", ["noise", "even", "cut"])
def test_what_cannot_be_followed_is_not(filmed: Filmed, what: str) -> None:
    rng = np.random.default_rng(0)
    images, masks = list(filmed.images), filmed.masks.copy()
    if what == "noise":
        images = [rng.integers(0, 255, image.shape, dtype=np.uint8) for image in images]
    elif what == "even":
        images = [np.full_like(image, 90) for image in images]
    else:
        masks[::2] = False
    features, matches = follow(filmed.egg.features, filmed.few, images, masks, CONFIG)
    for t in range(FRAMES - 1):
        assert len(matches[t, t + 1]) - 25 <= 2
    assert all(np.isfinite(frame.pixels).all() for frame in features)


def test_neighbours_with_many_matches_need_no_more(filmed: Filmed) -> None:
    config = replace(CONFIG, enough=25)
    features, matches = follow(filmed.egg.features, filmed.few, filmed.images, filmed.masks, config)
    assert matches.keys() == filmed.few.keys()
    assert all(np.array_equal(matches[pair], filmed.few[pair]) for pair in matches)
    assert all(new is old for new, old in zip(features, filmed.egg.features, strict=True))


def test_frames_without_features_or_matches_are_no_hindrance(filmed: Filmed) -> None:
    nothing = filmed.egg.features[3]._replace(
        **{name: part[:0] for name, part in filmed.egg.features[3]._asdict().items()}
    )
    features = [*filmed.egg.features[:3], nothing, *filmed.egg.features[4:]]
    found, matches = follow(features, {}, filmed.images, filmed.masks, CONFIG)
    # Features of frame 2 land in frame 3 and go on from there.
    assert len(matches[2, 3]) > 50 and len(matches[3, 4]) > 30
    assert len(found[3].pixels) == len(matches[2, 3])

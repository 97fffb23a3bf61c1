"""Points where features tell nothing, on an egg whose lower end has no features."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.spatial
from scipy.spatial.transform import Rotation

from bigs.motion.points import normalisation
from bigs.preprocess.artefacts import Alignment, ObjectSfm
from bigs.preprocess.object.rough_surface import SurfaceConfig
from bigs.preprocess.object.surface_points import SurfacePointsConfig, complete_points

FRAMES, WIDTH, HEIGHT, UNIT = 24, 160, 120, 0.3
AXES = np.array([0.05, 0.08, 0.04])
K = np.array([[420.0, 0.0, 80.0], [0.0, 420.0, 60.0], [0.0, 0.0, 1.0]])
# The egg has no features below this, metres.
BARE = 0.055
CONFIG = SurfacePointsConfig(surface=SurfaceConfig(resolution=40, frames=FRAMES, margin=0.03))
COLOR = np.array([200, 90, 30], dtype=np.uint8)


def egg_points(count: int, seed: int = 0) -> np.ndarray:
    directions = np.random.default_rng(seed).standard_normal((count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True) * AXES


@pytest.fixture(scope="module")
def motion() -> Alignment:
    """A full turn about the long axis, the lower end tilted towards the camera."""
    angles = np.linspace(0.0, 2.0 * np.pi, FRAMES, endpoint=False)
    tilt = Rotation.from_rotvec([np.radians(-35.0), 0.0, 0.0])
    rotations = (tilt * Rotation.from_rotvec(angles[:, None] * (0.0, 1.0, 0.0))).as_matrix()
    transl = np.tile([0.0, 0.0, 0.7], (FRAMES, 1))
    return Alignment(UNIT, rotations, transl, np.ones(FRAMES, dtype=bool), {})


@pytest.fixture(scope="module")
def masks(motion: Alignment) -> np.ndarray:
    """Which rays meet the egg."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([column + 0.5, row + 0.5, np.ones_like(row)], axis=-1) @ np.linalg.inv(K).T
    found = []
    for rotation, transl in zip(motion.object_rotations, motion.object_transl, strict=True):
        start, along = -transl @ rotation / AXES, rays @ rotation / AXES
        middle = along @ start
        found.append(middle**2 > (along**2).sum(-1) * (start @ start - 1.0))
    return np.where(found, 50, 0).astype(np.uint8)


def image(t: int) -> np.ndarray:
    return np.tile(COLOR, (HEIGHT, WIDTH, 1))


@pytest.fixture
def partly_seen(motion: Alignment) -> ObjectSfm:
    """Structure from motion's points of all but the lower end, and two strays."""
    points = egg_points(900)
    points = points[points[:, 1] < BARE]
    points = np.concatenate([points, [[0.08, -0.02, 0.0], [0.0, -0.04, 0.07]]]) / UNIT
    every = np.ones(FRAMES)
    colors = np.full(points.shape, 7, dtype=np.uint8)
    return ObjectSfm(
        motion.object_rotations, motion.object_transl / UNIT, every > 0, every, points, colors, np.eye(4)
    )


def off_surface(points: np.ndarray) -> np.ndarray:
    """Distance [N] to the egg, to first order."""
    inside = (points / AXES) ** 2
    return np.abs(inside.sum(1) - 1.0) / (2.0 * np.linalg.norm(points / AXES**2, axis=1))


def covered(points: np.ndarray) -> np.ndarray:
    """Distance of true surface points of the lower end from the nearest of `points`."""
    true = egg_points(9000, seed=1)
    return scipy.spatial.cKDTree(points).query(true[true[:, 1] > BARE])[0]


def test_the_bare_end_gets_points_on_the_surface(
    partly_seen: ObjectSfm, motion: Alignment, masks: np.ndarray
) -> None:
    found = complete_points(partly_seen, motion, image, masks, K, CONFIG)
    metric, count = UNIT * found.points, len(partly_seen.points) - 2
    new = metric[count:]
    assert (covered(UNIT * partly_seen.points) < 0.008).mean() < 0.5
    assert (covered(metric) < 0.008).mean() > 0.9
    assert np.percentile(off_surface(new), 95) < 0.003
    # What was there stays, but for the strays.
    assert np.array_equal(found.points[:count], partly_seen.points[:-2])
    assert (found.colors[:count] == 7).all() and (found.colors[count:][new[:, 1] > BARE] == COLOR).all()
    assert np.allclose(found.norm_mat, normalisation(found.points))
    # None is nearer to another than points usually are: they are no denser than the rest.
    apart = scipy.spatial.cKDTree(new).query(new, k=2)[0][:, 1]
    usual = scipy.spatial.cKDTree(metric[:count]).query(metric[:count], k=2)[0][:, 1]
    assert apart.min() > np.median(usual)


def test_what_a_hand_always_hides_is_closed(
    partly_seen: ObjectSfm, motion: Alignment, masks: np.ndarray
) -> None:
    hidden = masks.copy()
    hidden[:, 85:][masks[:, 85:] == 50] = 150
    found = complete_points(partly_seen, motion, image, hidden, K, CONFIG)
    count = len(partly_seen.points) - 2
    new = UNIT * found.points[count:]
    rows = []
    for rotation, transl in zip(motion.object_rotations, motion.object_transl, strict=True):
        cam = new @ rotation.T + transl
        rows.append(cam[:, 1] / cam[:, 2] * K[1, 1] + K[1, 2])
    never = np.min(rows, axis=0) > 86.0
    assert never.sum() >= 10
    # The convex hull of what shows, not of what hands may hide: it ends before the egg does.
    assert off_surface(new[never]).max() < 0.006 and new[never, 1].max() < AXES[1]
    assert covered(UNIT * found.points).max() < 0.012
    # No frame tells their colour: it is the mean of the nearest three that have one, as seen or motion's 7.
    mixtures = np.array([(k * COLOR.astype(float) + (3 - k) * 7.0) / 3.0 for k in range(4)]).round()
    assert (found.colors[count:][never][:, None] == mixtures).all(2).any(1).all()


def test_a_cloud_too_small_for_a_surface_stays_as_it_is(
    partly_seen: ObjectSfm, motion: Alignment, masks: np.ndarray
) -> None:
    few = replace(partly_seen, points=partly_seen.points[:20], colors=partly_seen.colors[:20])
    assert complete_points(few, motion, image, masks, K, CONFIG) is few


def test_a_cloud_without_gaps_gets_no_points(
    partly_seen: ObjectSfm, motion: Alignment, masks: np.ndarray
) -> None:
    found = complete_points(partly_seen, motion, image, masks, K, replace(CONFIG, gap=0.2))
    assert np.array_equal(found.points, partly_seen.points[:-2])
    assert np.array_equal(found.colors, partly_seen.colors[:-2])

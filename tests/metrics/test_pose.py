"""Pose scores on hand-made offsets."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bigs.metrics.pose import clip_scale, mpjpe, turn_errors, wrist_error


@pytest.fixture
def joints():
    return np.random.default_rng(0).normal(size=(5, 21, 3)) * 0.1 + [0.0, 0.0, 0.7]


def test_identical_joints_are_perfect(joints):
    assert np.array_equal(mpjpe(joints, joints), np.zeros(5))
    assert clip_scale(joints, joints) == pytest.approx(1.0)
    assert np.array_equal(wrist_error(joints, joints), np.zeros(5))


def test_mpjpe_does_not_see_translation(joints):
    assert np.allclose(mpjpe(joints + np.array([0.3, -0.2, 0.1]), joints), 0.0, atol=1e-9)


def test_mpjpe_counts_the_root_among_the_joints(joints):
    moved = joints.copy()
    moved[:, 1:] += [0.003, 0.0, 0.004]
    assert np.allclose(mpjpe(moved, joints), 5.0 * 20 / 21)


def test_clip_scale_is_the_least_squares_scale(joints):
    noisy = 0.8 * joints + np.random.default_rng(1).normal(size=joints.shape) * 0.01
    best = clip_scale(noisy, joints)
    squared = [np.sum((s * noisy - joints) ** 2) for s in (best - 1e-4, best, best + 1e-4)]
    assert squared[1] < squared[0]
    assert squared[1] < squared[2]


def test_clip_scale_leaves_out_what_is_not_finite(joints):
    pred, gt = 0.5 * joints, joints.copy()
    pred[0, 3, 1], gt[2, 7, 0] = np.nan, np.inf
    assert clip_scale(pred, gt) == pytest.approx(2.0)
    assert clip_scale(np.full((2, 3), np.nan), np.ones((2, 3))) == 1.0


def test_wrist_error_is_zero_after_the_right_scale(joints):
    assert np.allclose(wrist_error(0.5 * joints, joints, 2.0), 0.0, atol=1e-9)
    assert np.allclose(wrist_error(joints + np.array([0.0, 0.006, 0.008]), joints), 10.0)


def _turned(points, turns):
    return np.einsum("tij,nj->tni", turns.as_matrix(), points)


def test_turn_errors_are_what_is_left_after_one_turn_of_the_objects_frame():
    rng = np.random.default_rng(2)
    turns, own = Rotation.random(9, random_state=3), Rotation.random(random_state=4)
    gt = _turned(0.1 * rng.normal(size=(40, 3)), turns) + rng.normal(size=(9, 1, 3))
    other_mesh = 0.2 * rng.normal(size=(25, 3))
    assert turn_errors(_turned(other_mesh, turns * own), gt) == pytest.approx(0.0, abs=1e-5)
    off = Rotation.from_rotvec(np.radians(2.0) * np.eye(3)[[0]] * (np.arange(9) == 4)[:, None])
    errors = turn_errors(_turned(other_mesh, off * turns * own), gt)
    # One wrong frame of nine draws the common turn a little.
    assert errors[4] == pytest.approx(2.0, abs=0.1)
    assert np.delete(errors, 4) == pytest.approx(0.0, abs=0.1)


def test_turn_errors_leave_out_what_is_not_finite():
    rng = np.random.default_rng(5)
    verts = _turned(rng.normal(size=(10, 3)), Rotation.random(4, random_state=6))
    gt = verts.copy()
    gt[0] = np.nan
    errors = turn_errors(verts, gt)
    assert np.isnan(errors[0])
    assert errors[1:] == pytest.approx(0.0, abs=1e-5)
    assert np.isnan(turn_errors(verts, np.full_like(gt, np.nan))).all()

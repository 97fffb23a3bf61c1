"""Chamfer and F-score against brute force and hand-made offsets."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bigs.checks import InputError
from bigs.metrics.shape import chamfer, draw, f_score, relative_chamfer, relative_scores, shape_score


def brute_force(p, g):
    """Every pairwise distance in cm."""
    distances = 100.0 * np.linalg.norm(p[:, None] - g[None], axis=-1)
    return distances.min(axis=1), distances.min(axis=0)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 10_000))
def test_scores_are_those_of_brute_force(n, m, seed):
    rng = np.random.default_rng(seed)
    p, g = 0.02 * rng.normal(size=(n, 3)), 0.02 * rng.normal(size=(m, 3))
    p_to_g, g_to_p = brute_force(p, g)
    assert chamfer(p, g).squared == pytest.approx((p_to_g**2).mean() + (g_to_p**2).mean())
    assert chamfer(p, g).root == pytest.approx(p_to_g.mean() + g_to_p.mean())
    for threshold_mm in (5.0, 10.0):
        precision, recall = (p_to_g < threshold_mm / 10).mean(), (g_to_p < threshold_mm / 10).mean()
        expected = 200.0 * precision * recall / (precision + recall + 1e-7)
        assert f_score(p, g, threshold_mm) == pytest.approx(expected)
    assert shape_score(p, g) == (chamfer(p, g), f_score(p, g, 5.0), f_score(p, g, 10.0))


def test_identical_sets_are_perfect():
    points = np.random.default_rng(0).normal(size=(50, 3))
    assert shape_score(points, points) == ((0.0, 0.0), pytest.approx(100.0), pytest.approx(100.0))


def test_a_distant_pair_has_the_known_distances():
    p, g = np.zeros((1, 3)), np.array([[0.0, 0.03, 0.04]])
    assert chamfer(p, g) == pytest.approx((50.0, 10.0))
    assert f_score(p, g, 10.0) == 0.0


def test_the_f_score_threshold_is_in_millimetres():
    p, g = np.zeros((1, 3)), np.array([[0.0, 0.0, 0.007]])
    assert f_score(p, g, 5.0) == 0.0
    assert f_score(p, g, 10.0) == pytest.approx(100.0, abs=1e-4)


def test_relative_chamfer_sees_the_offset_between_object_and_wrist_only():
    rng = np.random.default_rng(0)
    object_verts, wrist = rng.normal(size=(3, 40, 3)), rng.normal(size=(3, 3))
    everywhere = np.array([5.0, 6.0, 7.0])
    same = relative_chamfer(object_verts + everywhere, wrist + everywhere, object_verts, wrist)
    assert np.allclose(same, 0.0, atol=1e-9)
    shifted = wrist + np.array([0.0, 0.0, 0.01])
    squared, root = relative_chamfer(object_verts, shifted, object_verts, wrist)
    # the points are far apart, so every neighbour is the point itself, 1 cm away
    assert np.allclose(squared, 2.0)
    assert np.allclose(root, 2.0)


def test_frames_that_are_not_finite_have_no_score():
    object_verts, wrist = np.random.default_rng(0).normal(size=(3, 40, 3)), np.zeros((3, 3))
    broken = object_verts.copy()
    broken[1, 4] = np.nan
    squared, _ = relative_chamfer(object_verts, wrist, broken, wrist)
    assert np.array_equal(np.isfinite(squared), [True, False, True])
    assert relative_scores(object_verts, wrist, broken, wrist)[1] is None


def test_large_sets_are_drawn_as_the_evaluators_do():
    points = np.arange(4000 * 3, dtype=np.float64).reshape(4000, 3)
    torch.manual_seed(1)
    evaluators = [points[torch.randperm(4000)[:3000]] for _ in range(2)]
    generator = torch.Generator().manual_seed(1)
    ours = [draw(points, 3000, generator) for _ in range(2)]
    assert np.array_equal(evaluators, ours)
    assert draw(points[:3000], 3000, generator).shape == (3000, 3)


def test_an_empty_set_is_named():
    with pytest.raises(InputError, match="predicted points: expected at least one"):
        chamfer(np.zeros((0, 3)), np.zeros((1, 3)))

"""Similarity ICP recovers what it must, from anywhere, and always the same."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from bigs.metrics import align
from bigs.metrics.align import similarity_icp
from bigs.metrics.shape import chamfer


@pytest.fixture(scope="module")
def drill():
    """A non-symmetric, non-convex shape: the drill of the development clips, or a made-up one like it."""
    clips = os.environ.get("BIGS_CLIPS")
    if clips and (Path(clips) / "dev_drill" / "gt_object.ply").exists():
        return trimesh.load(Path(clips) / "dev_drill" / "gt_object.ply", process=False)
    barrel = trimesh.creation.cylinder(0.025, 0.16)
    handle = trimesh.creation.box((0.03, 0.13, 0.04))
    foot = trimesh.creation.box((0.07, 0.03, 0.09))
    handle.apply_translation([0.0, 0.08, -0.03])
    foot.apply_translation([0.01, 0.15, -0.01])
    return trimesh.util.concatenate([barrel, handle, foot]).subdivide_to_size(0.006)


@pytest.mark.parametrize("seed", range(2))
def test_recovers_a_random_similarity(drill, seed):
    verts, faces = np.asarray(drill.vertices), np.asarray(drill.faces)
    rotation = Rotation.random(random_state=seed).as_matrix()
    scale, translation = 0.4 + 0.9 * seed, np.array([0.3, -1.0, 2.0])
    # other points of the same surface, so that no point has its perfect partner
    points, _ = trimesh.sample.sample_surface(drill, 3000, seed=seed)
    moved = (points - translation) @ rotation / scale
    fit = similarity_icp(moved, verts, None, faces)
    assert fit.scale == pytest.approx(scale, rel=5e-3)
    assert np.linalg.norm(fit.rotation @ rotation.T - np.eye(3)) < 0.02
    assert np.linalg.norm(fit.apply(moved) - points, axis=-1).mean() < 1e-3
    # as good as the true similarity
    assert fit.score.chamfer.squared < 1.02 * chamfer(points, verts).squared


def test_is_a_proper_similarity(drill):
    verts = np.asarray(drill.vertices)[::4]
    fit = similarity_icp(verts * [-1.0, 1.0, 1.0], verts)
    assert np.allclose(fit.rotation @ fit.rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(fit.rotation) == pytest.approx(1.0)


def test_identical_shapes_are_perfect(drill):
    verts = np.asarray(drill.vertices)[::4]
    fit = similarity_icp(verts, verts)
    assert fit.score.chamfer.root < 0.02
    assert fit.score.f5 == pytest.approx(100.0, abs=0.01)


def test_same_input_same_score(drill):
    points, _ = trimesh.sample.sample_surface(drill, 1500, seed=0)
    noise = 0.004 * np.random.default_rng(0).normal(size=points.shape)
    arguments = (points + noise, np.asarray(drill.vertices), None, np.asarray(drill.faces))
    first, second = similarity_icp(*arguments), similarity_icp(*arguments)
    assert first.score == second.score
    assert np.array_equal(first.rotation, second.rotation)


def test_starts_that_came_to_the_same_place_are_finished_once(drill, monkeypatch):
    finished = []

    def icp(source, target, starts, iterations, run=align._icp):
        finished.append(len(starts))
        return run(source, target, starts, iterations)

    monkeypatch.setattr(align, "_icp", icp)
    verts = np.asarray(drill.vertices)[::2]
    arguments = (verts @ Rotation.random(random_state=0).as_matrix(), verts)
    some = similarity_icp(*arguments)
    monkeypatch.setattr(align, "_SAME", 0.0)
    every = similarity_icp(*arguments)
    assert finished[0] == finished[2] == 60 and finished[1] < 0.7 * finished[3]
    assert np.allclose(some.rotation, every.rotation, atol=1e-3)
    assert some.score.chamfer.squared == pytest.approx(every.score.chamfer.squared, rel=2e-3, abs=1e-4)


def test_a_shape_without_extent_is_only_moved(drill):
    verts = np.asarray(drill.vertices)
    fit = similarity_icp(np.ones((20, 3)), verts)
    assert fit.scale == 1.0
    assert np.allclose(fit.apply(np.ones(3)), verts.mean(axis=0), atol=0.02)
    assert np.isfinite(fit.score.chamfer.squared)
    assert fit.score.f10 < 60.0

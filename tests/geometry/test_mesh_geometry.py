"""Mesh helpers on solids whose answers are known."""

import numpy as np
import pytest
import trimesh

from bigs.geometry.mesh import (
    face_areas,
    frames_from_normals,
    midpoint_subdivision,
    point_spacing,
    vertex_normals,
)


@pytest.fixture
def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=2, radius=0.05)


def test_vertex_normals_point_outwards(ball) -> None:
    normals = vertex_normals(ball.vertices, ball.faces)
    np.testing.assert_allclose(normals, ball.vertices / 0.05, atol=0.03)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    np.testing.assert_allclose(vertex_normals(ball.vertices, ball.faces[:, ::-1]), -normals, atol=1e-12)


def test_vertex_normals_weigh_faces_by_area() -> None:
    # At the origin a large face looks up z, a hundred times smaller one looks along x.
    verts = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 3, 4]])
    normal = vertex_normals(verts, faces)[0]
    np.testing.assert_allclose(normal, np.array([1.0, 0.0, 100.0]) / np.hypot(1.0, 100.0))


def test_a_vertex_of_no_face_has_no_normal() -> None:
    verts = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]])
    normals = vertex_normals(verts, np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(normals[3], 0.0)


def test_face_areas() -> None:
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    assert face_areas(box.vertices, box.faces).sum() == pytest.approx(2 * (2 + 3 + 6))
    assert sorted(face_areas(box.vertices, box.faces))[:4] == pytest.approx([1.0] * 4)


def test_subdivision_is_a_linear_map_that_keeps_constants_and_positions(ball) -> None:
    step, fine = midpoint_subdivision(ball.faces, len(ball.vertices))
    edges = len(ball.edges_unique)
    assert step.shape == (len(ball.vertices) + edges, len(ball.vertices))
    assert fine.shape == (4 * len(ball.faces), 3)
    np.testing.assert_array_equal(np.asarray(step.sum(axis=1)).ravel(), 1.0)
    moved = step @ ball.vertices
    np.testing.assert_array_equal(moved[: len(ball.vertices)], ball.vertices)
    middles = ball.vertices[ball.edges_unique].mean(axis=1)
    distance = np.linalg.norm(moved[len(ball.vertices) :, None] - middles, axis=-1)
    assert distance.min(axis=1).max() < 1e-12 and distance.min(axis=0).max() < 1e-12


def test_subdivision_keeps_surface_orientation_and_closure(ball) -> None:
    step, fine = midpoint_subdivision(ball.faces, len(ball.vertices))
    mesh = trimesh.Trimesh(step @ ball.vertices, fine, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(ball.volume)
    assert mesh.area == pytest.approx(ball.area)
    np.testing.assert_allclose(mesh.area_faces, np.tile(ball.area_faces / 4, 4))


def test_point_spacing_of_a_lattice() -> None:
    axis = 0.25 * np.arange(5)
    lattice = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(point_spacing(lattice, neighbours=3), 0.25)
    corner, edge = point_spacing(np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]), neighbours=1)[[0, 2]]
    assert (corner, edge) == (1.0, 2.0)
    assert point_spacing(np.zeros((1, 3))).tolist() == [0.0]
    assert point_spacing(np.array([[0.0, 0, 0], [0, 2, 0]])).tolist() == [2.0, 2.0]


def test_frames_are_rotations_whose_third_column_is_the_normal() -> None:
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.concatenate([normals, np.eye(3), -np.eye(3)])
    frames = frames_from_normals(normals)
    np.testing.assert_allclose(frames[:, :, 2], normals)
    np.testing.assert_allclose(
        frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frames.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(frames), 1.0)

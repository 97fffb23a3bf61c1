"""Conversions against the matrix exponential, near the identity and near half turns on purpose."""

import math

import pytest
import torch

from bigs.geometry.rotations import (
    axis_angle_to_matrix,
    matrix_to_axis_angle,
    matrix_to_quat,
    mean_rotation,
    project_to_rotation,
    quat_multiply,
    quat_to_matrix,
    rot6d_to_matrix,
    rotation_angle,
)

ANGLES = [0.0, 1e-9, 1e-4, 1e-3, 0.5, 2.0, math.pi - 1e-3, math.pi - 1e-7, math.pi]


def axes() -> torch.Tensor:
    """Unit vectors [9, 3]: the coordinate axes, their diagonal and random ones."""
    generator = torch.Generator().manual_seed(0)
    some = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(torch.cat([torch.eye(3).double(), torch.ones(1, 3), some]), dim=-1)


def skew(vectors: torch.Tensor) -> torch.Tensor:
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return torch.stack(rows, -2)


def random_rotations(count: int, seed: int = 1) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.linalg.matrix_exp(skew(torch.randn(count, 3, generator=generator, dtype=torch.float64)))


@pytest.mark.parametrize("angle", ANGLES)
def test_axis_angle_is_the_matrix_exponential(angle: float) -> None:
    vectors = angle * axes()
    torch.testing.assert_close(
        axis_angle_to_matrix(vectors), torch.linalg.matrix_exp(skew(vectors)), atol=1e-12, rtol=0
    )


@pytest.mark.parametrize("angle", ANGLES)
def test_round_trips_keep_the_rotation(angle: float) -> None:
    matrices = torch.linalg.matrix_exp(skew(angle * axes()))
    back = matrix_to_axis_angle(matrices)
    assert back.norm(dim=-1).max() <= math.pi + 1e-9
    # kornia's series near the identity leaves 2e-10
    torch.testing.assert_close(axis_angle_to_matrix(back), matrices, atol=1e-9, rtol=0)
    quats = matrix_to_quat(matrices)
    torch.testing.assert_close(quats.norm(dim=-1), torch.ones(len(quats)).double(), atol=1e-7, rtol=0)
    torch.testing.assert_close(quat_to_matrix(quats), matrices, atol=1e-7, rtol=0)
    torch.testing.assert_close(
        rotation_angle(matrices), torch.full((len(matrices),), angle).double(), atol=1e-7, rtol=0
    )


@pytest.mark.parametrize("angle", [1e-9, 1e-4, 0.5, 2.0, math.pi - 1e-3])
def test_rotation_vectors_come_back_as_they_were(angle: float) -> None:
    vectors = angle * axes()
    torch.testing.assert_close(
        matrix_to_axis_angle(axis_angle_to_matrix(vectors)), vectors, atol=1e-9, rtol=0
    )


def test_leading_axes_are_kept() -> None:
    vectors = torch.randn(2, 5, 3)
    matrices = axis_angle_to_matrix(vectors)
    assert matrices.shape == (2, 5, 3, 3)
    assert matrix_to_axis_angle(matrices).shape == (2, 5, 3)
    assert matrix_to_quat(matrices).shape == (2, 5, 4)
    torch.testing.assert_close(
        quat_to_matrix(matrix_to_quat(matrices))[1, 3], axis_angle_to_matrix(vectors[1, 3])
    )


def test_quaternions_are_w_first_and_may_have_any_length() -> None:
    half = math.sqrt(0.5)
    about_z = torch.tensor([half, 0.0, 0.0, half], dtype=torch.float64)
    expected = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(quat_to_matrix(-7.0 * about_z), expected)
    torch.testing.assert_close(matrix_to_quat(expected), about_z)


def test_quaternion_product_turns_by_the_second_first() -> None:
    a, b = random_rotations(20, 1), random_rotations(20, 2)
    product = quat_multiply(3.0 * matrix_to_quat(a), matrix_to_quat(b))
    torch.testing.assert_close(quat_to_matrix(product), a @ b)


def test_rot6d_orthonormalises_two_columns() -> None:
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    assert torch.equal(rot6d_to_matrix(identity), torch.eye(3))
    rotations = random_rotations(10)
    x, y = rotations[..., 0], rotations[..., 1]
    skewed = torch.cat([2.0 * x, 0.5 * y + 0.3 * x], dim=-1)
    torch.testing.assert_close(rot6d_to_matrix(skewed), rotations)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, math.pi - 1e-4, math.pi])
def test_gradients_of_rotation_vectors(angle: float) -> None:
    vectors = (angle * axes()[3:]).requires_grad_()
    assert torch.autograd.gradcheck(axis_angle_to_matrix, vectors)
    assert torch.autograd.gradcheck(lambda v: matrix_to_quat(axis_angle_to_matrix(v)), vectors)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 1.0, 3.0])
def test_gradients_of_the_logarithm(angle: float) -> None:
    vectors = (angle * axes()).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda v: matrix_to_axis_angle(axis_angle_to_matrix(v)), vectors, atol=1e-4
    )


def test_gradients_of_quaternions_and_6d() -> None:
    generator = torch.Generator().manual_seed(3)
    a, b = torch.randn(2, 4, 4, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(quat_multiply, (a, b))
    assert torch.autograd.gradcheck(quat_to_matrix, (a,))
    sixes = torch.randn(4, 6, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(rot6d_to_matrix, (sixes,))


def test_projection_is_the_nearest_proper_rotation() -> None:
    generator = torch.Generator().manual_seed(4)
    matrices = torch.randn(30, 3, 3, generator=generator, dtype=torch.float64)
    assert (torch.linalg.det(matrices) < 0).any()
    nearest = project_to_rotation(matrices)
    torch.testing.assert_close(nearest @ nearest.mT, torch.eye(3).double().expand(30, 3, 3))
    torch.testing.assert_close(torch.linalg.det(nearest), torch.ones(30).double())
    others = random_rotations(2000)
    gap = (matrices[:, None] - others).flatten(2).norm(dim=-1).min(dim=1).values
    assert ((matrices - nearest).flatten(1).norm(dim=-1) <= gap).all()


def test_mean_rotation_lies_between_and_obeys_weights() -> None:
    turn = torch.tensor([0.0, 0.0, 0.8], dtype=torch.float64)
    pair = axis_angle_to_matrix(torch.stack([turn, -turn]))
    middle = mean_rotation(pair, torch.ones(2).double())
    torch.testing.assert_close(middle, torch.eye(3).double())
    torch.testing.assert_close(mean_rotation(pair, torch.tensor([2.0, 0.0]).double()), pair[0])
    nearer_first = mean_rotation(pair, torch.tensor([3.0, 1.0]).double())
    assert 0.1 < matrix_to_axis_angle(nearer_first)[2] < 0.8
